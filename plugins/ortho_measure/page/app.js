// The page: the point in progress, requests, keys. The server computes; it saves every action before the page shows it.
import { Table } from './table.js';
import { PANES, Views, geometryOf } from './views.js';

/** An element of the page; a test checks that it exists. @type {(id: string) => any} */
const $ = (id) => document.getElementById(id);
const windowName = crypto.randomUUID();
/** @type {Facts} */ let facts;
/** @type {State} */ let state;
/** @type {Views} */ let views;
/** @type {Table} */ let table;
/** @type {string|null} */ let selected = null;
/** The point in progress. @type {Pending|null} */ let pending = null;
let skipped = 0; // offered places that were skipped
let turn = 0; // number of the newest request: answers to older ones are not shown
/** Bands and contrast of each view. @type {{[view: string]: Look}} */ const looks = {};
const compared = { flicker: false, difference: false, swipe: 0 };

/** @template {keyof Answers} W @param {W} what @param {object} [given] @returns {Promise<Answers[W]>} */
async function ask(what, given = {}) {
  const response = await fetch(`api/${what}`, { method: 'POST', headers: { 'content-type': 'application/json' }, body: JSON.stringify({ window: windowName, ...given }) });
  const answer = await response.json().catch(() => ({ error: { message: `server error ${response.status}` } }));
  if (response.ok) return answer;
  // Another window has taken over: follow it, because this one may show old points.
  if (response.status === 409) { facts.writes = false; banner(); fill(); }
  const { message, remedy } = answer.error;
  throw new Error(`${message}${remedy ? ` (${remedy})` : ''}`);
}

function say(text, bad = false) {
  $('said').textContent = text;
  $('said').className = bad ? 'bad' : '';
}

/** Run work that may fail, and show its error. @template {any[]} G, T @param {(...given: G) => Promise<T>} work @returns {(...given: G) => Promise<T|undefined>} */
const safely = (work) => async (...given) => {
  try { return await work(...given); } catch (error) {
    say(error instanceof TypeError ? 'No answer from ortho measure. All accepted points are saved. Start ortho measure again.' : String(error instanceof Error ? error.message : error), true);
    return undefined;
  }
};

const nextPlace = () => state.next[skipped % Math.max(state.next.length, 1)];

const shownMarks = () => state.marks.map((mark) => ({ ...mark, ...(state.points[mark.id] ?? {}) }));
const markOf = (id) => state.marks.find((mark) => mark.id === id);
const number = (value, digits) => (value === null || value === undefined ? '–' : value.toFixed(digits));

const look = (name) => (looks[name] ??= { bands: [0], limits: null });
/** Number of the image whose geometry a view has; null for a map. */
const imageOf = (name) => { const [kind, number] = geometryOf(name).split('-'); return kind === 'scene' ? Number(number) : null; };

/** Name of the image of a view in the points, if there are several images. */
const labelOf = (name) => (facts.labels && name.startsWith('scene-') ? facts.labels[imageOf(name)] : null);

/** The reference in the geometry of the left pane, if there is one, for flicker and difference. */
const overlay = () => { const name = `reference-${imageOf(views.shows.scene)}`; return facts.bands[name] ? name : null; };

async function showTiles(names = Object.values(views.shows)) {
  await Promise.all([...new Set(names)].map(async (name) => {
    const one = look(name);
    one.limits ??= (await ask('stretch', { pane: name, bands: one.bands, version: state.version })).limits;
    views.of(name).show({ version: state.version, ...one });
  }));
}

/** Position of a mark in a view, and its residual: measured in an image, otherwise the position of its ground. */
function placed(mark, name) {
  const label = labelOf(name);
  if (!name.startsWith('scene-')) return { place: mark.places?.[name] ?? null };
  if (!facts.labels) return { place: mark.image ?? null, residual: mark.residual };
  const ray = mark.rays?.[label];
  return ray ? { place: ray.image, residual: mark.residuals?.[label] } : { place: mark.places?.[name] ?? null, expected: true };
}

/** Whether a point is complete. */
function complete(mark) {
  if (!mark) return false;
  if (!facts.labels) return Boolean(mark.image && mark.ground);
  const rays = Object.keys(mark.rays).length;
  const role = $('role').value;
  return role === 'tie' ? rays >= 2 : Boolean(mark.ground) && rays >= (role === 'control' ? 1 : 2);
}

/** What a point of a role needs. */
function needs(role) {
  if (!facts.labels) return 'Click the point in both the scene and the reference.';
  return { tie: 'Measure a tie point in at least two images.', control: 'A control point needs ground coordinates and one image.', check: 'A check point needs ground coordinates and two images.' }[role];
}

function draw() {
  const marks = shownMarks();
  views.draw(marks, selected, pending, nextPlace(), placed);
  table.draw(marks, selected);
}

function show(next) {
  const rendered = state && state.version !== next.version;
  state = next;
  const { headline } = state;
  const figures = [headline.px === null ? '' : `${headline.px.toFixed(3)} px`, headline.m === null ? '' : `${headline.m.toFixed(3)} m`];
  $('figure').textContent = figures.filter(Boolean).join(', ') || 'Accuracy unknown:';
  $('what').textContent = state.error || headline.what;
  $('headline').title = $('what').textContent;
  $('undo').disabled = !state.undo || !facts.writes;
  $('redo').disabled = !state.redo || !facts.writes;
  const counted = state.marks.filter((mark) => !mark.off);
  $('make').disabled = !facts.writes || !(facts.labels ? Object.keys(state.points).length : counted.some((mark) => mark.role === 'control'));
  $('correction').value = state.correction ?? '';
  skipped = 0;
  tellNext();
  const items = state.notices.map((text) => { const item = document.createElement('li'); item.textContent = text; return item; });
  $('notices').replaceChildren(...items);
  $('doubts-title').textContent = `Notices (${items.length})`;
  draw();
  if (rendered) safely(showTiles)([...Object.values(views.shows), overlay()].filter((name) => name?.startsWith('reference-')));
  // The relation of the two geometries has changed with the model.
  if (rendered) views.relink();
}

/** Which part of an image a position is in, in words. */
function partOf([column, row], [width, height]) {
  const vertical = row < height / 3 ? 'upper' : row > (2 * height) / 3 ? 'lower' : '';
  const horizontal = column < width / 3 ? 'left' : column > (2 * width) / 3 ? 'right' : '';
  return [vertical, horizontal].filter(Boolean).join(' ') || 'middle';
}

function tellNext() {
  const place = nextPlace();
  if (!place) { $('gain').textContent = ''; return; }
  const [column, row] = place.image.map((value) => value.toFixed(0));
  const what = { tie: 'tie', control: 'control point' }[facts.labels ? place.role : ''] ?? 'point';
  const where = `${partOf(place.image, facts.images[place.number].size)} (column ${column}, row ${row})${facts.labels ? ` of ${facts.labels[place.number]}` : ''}`;
  const gain = place.sigma === null ? '' : ` It reduces the largest uncertainty from ${place.largest.toFixed(3)} to ${place.then.toFixed(3)} px.`;
  $('gain').textContent = `Best next ${what}: ${where}.${gain}`;
}

function fill() {
  const mark = pending ?? /** @type {Partial<Pending>} */ ({});
  $('name').value = mark.id ?? '';
  $('role').value = mark.role ?? (facts.labels ? $('role').value : 'control');
  $('sigma').value = mark.sigma_image ?? '';
  const covariances = [mark, ...Object.values(mark.rays ?? {})].map((one) => one.covariance).filter(Boolean);
  const variance = covariances.reduce((sum, [column, row]) => sum + (column + row) / 2, 0) / covariances.length;
  $('sigma').placeholder = covariances.length ? Math.sqrt(variance).toFixed(3) : '0.5';
  $('note').value = mark.note ?? '';
  $('sigma-xy').value = mark.sigma_xy || '';
  $('sigma-h').value = mark.sigma_h || '';
  const writes = facts.writes;
  $('accept').disabled = !writes || !complete(pending);
  $('cancel').disabled = !pending;
  $('off').disabled = $('remove').disabled = !writes || !selected;
  $('next').disabled = !state.next.length;
}

function freeName() {
  let count = state.marks.length + 1;
  while (markOf(`P${count}`)) count += 1;
  return `P${count}`;
}

function begin() {
  pending ??= { id: freeName(), role: $('role').value || 'control', off: false, ground: null, how: 'manual', ground_from: null, sigma_xy: 0, sigma_h: 0, note: '', rays: {}, first: null };
}

function cancel() {
  turn += 1;
  pending = null;
  selected = null;
  say('Click a feature. Or press n for the best next place, then m to measure it.');
  fill();
  draw();
}

/** Copy a match into the point in progress, or show why there is none. */
function take(found, wanted) {
  if (found.reason) {
    pending.score = null;
    pending.covariance = null;
    const other = pending.image && pending.ground ? 'Press Enter to accept your click, or move it with the arrow keys.' : `Click the same feature in the ${wanted}.`;
    say(`No match: ${found.reason}. ${other}`, true);
    return;
  }
  Object.assign(pending, { image: found.image, ground: found.ground, score: found.score, covariance: found.covariance, how: 'matched', sigma_image: null });
  pending.ground_from ??= 'reference';
  const sigma = Math.sqrt((found.covariance[0] + found.covariance[1]) / 2);
  say(`Matched: score ${found.score.toFixed(3)}, ±${sigma.toFixed(3)} px${found.scattered ? ` (from ${found.scattered} neighbours)` : ' (assumed)'}. Press Enter to accept.`);
}

/** Copy matches in all images into the point in progress, and show which images have none. */
function takeRays({ rays, ground }, clicked) {
  const told = [];
  for (const [label, ray] of Object.entries(rays)) {
    if (ray.image && !ray.reason) {
      const by = ray.covariance ? 'matched' : 'manual';
      pending.rays[label] = { image: ray.image, covariance: ray.covariance ?? null, score: ray.score ?? null, how: by };
      if (label !== clicked && by === 'matched') told.push(`${label} ±${Math.sqrt((ray.covariance[0] + ray.covariance[1]) / 2).toFixed(3)} px`);
    }
  }
  const missing = Object.entries(rays).filter(([, ray]) => ray.reason && ray.seen);
  if (ground && !ground.reason && !pending.by_hand) Object.assign(pending, { ground: ground.ground, ground_from: 'reference' });
  const none = missing.map(([label, { reason }]) => ` No match in ${label}: ${reason}. Click it there.`).join('');
  const unknown = ground?.reason && !pending.ground ? ` Reference: ${ground.reason}.` : '';
  say(`${told.length ? `Matched: ${told.join(', ')}.` : ''}${none}${unknown}${complete(pending) ? ' Press Enter to accept.' : ''}`.trim(), !complete(pending));
}

/** Measure a position in one of several images, or ground in the reference. */
async function tie(name, place, mine) {
  const label = labelOf(name);
  if (label) {
    const again = pending.first === null || pending.first === label;
    if (again) Object.assign(pending, { rays: {}, first: label });
    else pending.rays[label] = { image: place, covariance: null, score: null, how: 'manual' };
    const known = again ? {} : { [pending.first]: pending.rays[pending.first].image };
    const found = await ask('tie', { number: imageOf(name), image: place, known });
    if (mine !== turn) return;
    takeRays(found, label);
  } else {
    const there = await ask('predict', { at: name, place, version: state.version });
    if (mine !== turn) return;
    if (!there.ground) { say('The reference has no data here.', true); return; }
    Object.assign(pending, { ground: there.ground, ground_from: 'reference', by_hand: true });
    if ($('role').value === 'tie') { pending.role = 'control'; $('role').value = 'control'; }
    if (Object.keys(pending.rays).length) say('Ground coordinates set. Press Enter to accept.');
    else {
      const found = await ask('tie', { ground: there.ground });
      if (mine !== turn) return;
      takeRays(found, null);
      pending.first = Object.keys(pending.rays)[0] ?? null;
    }
  }
  await locate(mine);
}

/** Whether a position is within the image of a view, plus half a pixel; references answer this themselves. */
function within(name, place) {
  const [kind, number] = name.split('-');
  return kind !== 'scene' || place.every((value, axis) => value >= -0.5 && value <= facts.images[number].size[axis] + 0.5);
}

const measure = safely(async (pane, place) => {
  if (!within(views.shows[pane], place)) { say('You clicked outside the image.', true); return; }
  begin();
  const mine = (turn += 1);
  const name = views.shows[pane];
  say('Matching …');
  if (facts.labels) { await tie(name, place, mine); return; }
  if (name.startsWith('scene-')) {
    const known = pending.ground && (pending.by_hand || pending.ground_from !== 'reference') ? pending.ground : null;
    Object.assign(pending, { image: place, how: 'manual', covariance: null, score: null, clicked: true });
    const found = await ask('propose', { image: place, ground: known });
    if (mine !== turn) return;
    if (found.reason && !known) { pending.ground = null; pending.ground_from = null; }
    take(found, 'reference');
  } else {
    const there = await ask('predict', { at: name, place, version: state.version });
    if (mine !== turn) return;
    if (!there.ground) { say('The reference has no data here.', true); return; }
    Object.assign(pending, { ground: there.ground, ground_from: 'reference', by_hand: true });
    const found = await ask('propose', { image: pending.clicked ? pending.image : null, ground: there.ground });
    if (mine !== turn) return;
    take(found, 'scene');
  }
  await locate(mine);
});

/** Request the positions of the ground of the point in progress, and draw it. */
async function locate(mine) {
  const [first] = Object.entries(pending.rays ?? {});
  const seen = first ? { at: `scene-${facts.labels.indexOf(first[0])}`, place: first[1].image } : { at: 'scene-0', place: pending.image };
  const there = await ask('predict', { ...(pending.ground ? { ground: pending.ground } : seen), version: state.version });
  if (mine !== turn || !pending) return;
  pending.places = there.places;
  fill();
  draw();
}

/** The measurement that the arrow keys move in a pane, if one is in progress. */
function movable(pane) {
  const label = pane && facts.labels && labelOf(views.shows[pane]);
  if (label) return pending?.rays[label] ?? null;
  return !facts.labels && pending?.image ? pending : null;
}

const nudge = safely(async (pane, column, row) => {
  const moved = movable(pane);
  if (!moved) return;
  const mine = (turn += 1);
  Object.assign(moved, { image: [moved.image[0] + column, moved.image[1] + row], how: 'manual', covariance: null, score: null });
  pending.clicked = true;
  say(`Manual: column ${moved.image[0].toFixed(2)}, row ${moved.image[1].toFixed(2)}. Press Enter to accept.`);
  fill();
  draw();
  if (!pending.places) await locate(mine);
});

const decimal = (id) => {
  const text = $(id).value.trim().replace(',', '.');
  if (!text) return null;
  const value = Number(text);
  if (!Number.isFinite(value)) throw new Error(`${$(id).parentElement.firstChild.textContent.trim()}: this is not a number`);
  return value;
};

/** The members of a mark that the server knows. */
const only = (object, keys) => Object.fromEntries(keys.filter((key) => object[key] !== undefined).map((key) => [key, object[key]]));
const plain = (mark) => (facts.labels ? {
  ...only(mark, ['id', 'ground', 'role', 'off', 'sigma_xy', 'sigma_h', 'sigma_common', 'how', 'ground_from', 'note']),
  rays: Object.fromEntries(Object.entries(mark.rays).map(([label, ray]) => [label, only(ray, ['image', 'sigma_image', 'covariance', 'group', 'how', 'score'])])),
} : only(mark, ['id', 'image', 'ground', 'role', 'off', 'sigma_image', 'covariance', 'sigma_xy', 'sigma_h', 'sigma_common', 'sigma_alike', 'group', 'how', 'ground_from', 'score', 'note']));

const act = safely(async (action) => { const next = await ask('act', { action }); show(next); return next; });

const accept = safely(async () => {
  if (!complete(pending)) {
    say(needs($('role').value), true);
    return;
  }
  const sigma = decimal('sigma');
  if (sigma !== null) for (const ray of Object.values(pending.rays ?? {})) Object.assign(ray, { sigma_image: sigma, covariance: null });
  const mark = plain({ ...pending, id: $('name').value.trim() || freeName(), role: $('role').value, note: $('note').value,
    sigma_xy: decimal('sigma-xy') ?? 0, sigma_h: decimal('sigma-h') ?? 0,
    ...(sigma === null ? {} : { sigma_image: sigma, covariance: null }) });
  say(`Saving ${mark.id} …`);
  const done = await act({ do: 'put', mark, ...(pending.was ? { was: pending.was } : {}) });
  if (!done) return;
  pending = null;
  selected = null;
  say(`${mark.id} accepted.`);
  fill();
  draw();
});

/** Start to edit an existing point. */
function edit(id) {
  const mark = markOf(id);
  turn += 1;
  selected = id;
  const rays = Object.fromEntries(Object.entries(mark.rays ?? {}).map(([label, ray]) => [label, { ...ray }]));
  pending = { ...mark, rays, first: Object.keys(rays)[0] ?? null, was: id, by_hand: true, clicked: true };
  say(`${id} (${mark.role}${facts.labels ? '' : `, ${mark.how}`}${mark.off ? ', off' : ''}). Move it with the arrow keys, click again, or edit the fields; press Enter to save.`);
  return { mark, rays };
}

function choose(id) {
  if (!markOf(id)) return;
  const { mark, rays } = edit(id);
  views.goTo({ ...mark.places, ...(mark.image ? { 'scene-0': mark.image } : {}), ...Object.fromEntries(Object.entries(rays).map(([label, ray]) => [`scene-${facts.labels.indexOf(label)}`, ray.image])) }, 1);
  fill();
  draw();
}

const toggleOff = () => { const mark = selected && markOf(selected); if (mark) act({ do: 'put', mark: plain({ ...mark, off: !mark.off }), was: mark.id }).then(() => choose(mark.id)); };
const remove = () => { if (selected) { const id = selected; cancel(); act({ do: 'remove', id }); } };
/** Whether an image shows an offered place. */
function shownWithin({ places }, number) {
  const place = places[`scene-${number}`];
  return Boolean(place) && place.every((value, axis) => value >= 0 && value <= facts.images[number].size[axis]);
}

/** Go to the best next place; from there to the second best, and so on. */
function goNext() {
  if (!state.next.length) return;
  const [column, row] = views.middle('scene');
  const [x, y] = nextPlace().places[views.shows.scene] ?? [Infinity, Infinity];
  if (Math.hypot(x - column, y - row) < 1) skipped += 1;
  cancel();
  // In a block, the left view must show an image that contains the place.
  const there = nextPlace();
  if (facts.labels && !shownWithin(there, imageOf(views.shows.scene))) showIn('scene', `scene-${there.number}`);
  views.goTo(there.places, 1);
  tellNext();
  say('Best next place: press m to measure the feature in the middle, or click one. Press n for another place.');
}

const dragged = safely(async (pane, id, place) => {
  const mark = markOf(id);
  if (!mark || !facts.writes) { draw(); return; }
  const changed = { ...mark, how: 'manual', covariance: null, score: null };
  const name = views.shows[pane];
  const label = labelOf(name);
  if (label) changed.rays = { ...mark.rays, [label]: { image: place, how: 'manual', covariance: null, score: null } };
  else if (name.startsWith('scene-')) changed.image = place;
  else {
    const there = await ask('predict', { at: name, place, version: state.version });
    if (!there.ground) { draw(); return; }
    Object.assign(changed, { ground: there.ground, ground_from: 'reference' });
  }
  await act({ do: 'put', mark: plain(changed), was: id });
  // Edit the point at its new position; otherwise Enter would move it back.
  if (pending?.was === id) { edit(id); fill(); draw(); }
});

async function compare(change) {
  Object.assign(compared, change);
  if (overlay()) await safely(showTiles)([overlay()]);
  views.compare(overlay(), compared);
  for (const name of ['flicker', 'difference']) $(name).setAttribute('aria-pressed', String(compared[name]));
}

const stretch = safely(async () => {
  for (const pane of PANES) {
    const name = views.shows[pane];
    look(name).limits = (await ask('stretch', { pane: name, bands: look(name).bands, version: state.version, box: views.box(pane) })).limits;
  }
  await showTiles();
});

function cells(values, kind) { return values.map((value) => { const cell = document.createElement(kind); cell.textContent = value; return cell; }); }

const models = safely(async () => {
  say('Comparing models …');
  const { rows, recommendation } = await ask('compare');
  const total = (rmse, which) => number(rmse?.[which]?.total, 3);
  const figures = facts.labels ? ['Check, m', 'Control leave-one-out, m', 'Rays leave-one-out, px'] : ['Control, px', 'Check, px', 'Leave-one-out, px'];
  const values = facts.labels ? (one) => [one.check_m, one.loo_m, one.rays].map((value) => number(value, 3))
    : ({ rmse }) => ['control', 'check', 'loo'].map((which) => total(rmse, which));
  const head = document.createElement('tr');
  head.append(...cells([facts.labels ? 'Correction' : 'Model', 'Parameters', ...figures], 'th'));
  $('models').tHead.replaceChildren(head);
  $('models').tBodies[0].replaceChildren(...rows.map((one) => {
    const row = document.createElement('tr');
    row.append(...cells([one.model, one.parameters, ...(one.error ? ['not fitted', '', ''] : values(one))], 'td'));
    if (one.error) row.title = one.error;
    return row;
  }));
  $('recommended').textContent = recommendation.model ? `Recommended: ${recommendation.model}. ${recommendation.reason}.` : recommendation.reason;
  say('');
  $('compared').showModal();
});

const wait = (milliseconds) => new Promise((resolve) => { setTimeout(resolve, milliseconds); });
let making = false;

/** Make the ortho, show its progress, then compare it with the reference. */
const makeOrtho = safely(async () => {
  $('ortho').showModal();
  if (making) return;
  making = true;
  try {
    $('ortho-done').hidden = true;
    $('ortho-share').hidden = false;
    // With several images, use the one of the left view.
    let told = await ask('make', { number: imageOf(geometryOf(views.shows.scene)) });
    const of = facts.labels ? `${facts.images[told.number].name}: ` : '';
    while (told.state === 'running') {
      $('ortho-share').value = told.share;
      $('ortho-said').textContent = of + (told.stage ? `${told.stage}: ${Math.round(100 * told.share)} %. You can close this window and continue measuring.` : 'Reading and fitting …');
      await wait(300);
      told = await ask('made');
    }
    $('ortho-share').hidden = true;
    if (told.state !== 'done') { $('ortho-said').textContent = `The ortho failed: ${told.error}`; return; }
    $('ortho-said').textContent = `${of}${told.figure}: ${told.what}.`;
    const again = Date.now();
    $('ortho-own').src = `made/ortho?${again}`;
    const compares = facts.maps.length > 0;
    $('ortho-reference').hidden = $('ortho-mix').parentElement.hidden = !compares;
    if (compares) $('ortho-reference').src = `made/reference?${again}`;
    $('ortho-report').href = `made/report?${again}`;
    $('ortho-files').replaceChildren(...told.files.map((name) => { const item = document.createElement('li'); item.textContent = name; return item; }));
    $('ortho-done').hidden = false;
  } catch (error) {
    $('ortho-share').hidden = true;
    $('ortho-said').textContent = error instanceof Error ? error.message : String(error);
    throw error;
  } finally { making = false; }
});

const typed = safely(async () => {
  begin();
  const mine = (turn += 1);
  const { ground } = await ask('typed', { values: [decimal('x'), decimal('y'), decimal('h')], crs: $('crs').value, vertical: $('vertical').value });
  Object.assign(pending, { ground, ground_from: 'typed', by_hand: true, sigma_xy: decimal('sigma-xy') ?? 0, sigma_h: decimal('sigma-h') ?? 0 });
  const there = await ask('predict', { ground, version: state.version });
  if (mine !== turn) return;
  pending.places = there.places;
  views.goTo(there.places, 1);
  say('Coordinates set. Now click the point in the scene; its expected position is in the middle.');
  fill();
  draw();
});

/** Set the chosen role of the point in progress, and show what is missing. */
function changeRole() {
  const { value } = $('role');
  if (pending) pending.role = value;
  const missing = pending && !complete(pending);
  say(`Role: ${value}.${missing ? ` ${needs(value)}` : pending ? ' Press Enter to accept.' : ''}`, missing);
  if (pending) fill();
}

function pressed(event) {
  const { target, key } = event;
  if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector('dialog[open]')) return;
  const typing = target.matches('input:not([type="range"]), select, textarea');
  if (key === 'Escape') { cancel(); return; }
  if (typing) { if (key === 'Enter' && target.closest('#point')) { event.preventDefault(); accept(); } return; }
  const inMap = target.classList.contains('map');
  const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[key];
  if (arrow && inMap && movable(target.id)) {
    event.preventDefault();
    event.stopPropagation(); // the view does not pan
    const step = event.shiftKey ? 1 : 0.1;
    nudge(target.id, arrow[0] * step, arrow[1] * step);
    return;
  }
  const along = (step) => { const { order } = table; if (order.length) choose(order[(order.indexOf(selected) + step + order.length) % order.length] ?? order[0]); };
  const keys = {
    m: () => { const pane = target.id === 'reference' ? 'reference' : 'scene'; measure(pane, views.middle(pane)); },
    u: () => { const select = $('reference-shows'); showIn('reference', select.options[(select.selectedIndex + 1) % select.options.length].value); },
    n: goNext, j: () => along(1), k: () => along(-1), o: toggleOff, Delete: remove, s: stretch, c: models, g: makeOrtho,
    r: () => { const roles = ['control', 'check', 'tie']; $('role').value = roles[(roles.indexOf($('role').value) + 1) % 3]; changeRole(); },
    f: () => compare({ flicker: !compared.flicker, difference: false }), d: () => compare({ difference: !compared.difference, flicker: false }),
    z: () => act({ do: 'undo' }), Z: () => act({ do: 'redo' }), '?': () => $('keys').showModal(),
  };
  if (key === 'Enter' && (inMap || target === document.body)) { event.preventDefault(); accept(); } else if (keys[key]) { event.preventDefault(); keys[key](); }
}

/** Choices of a pane: names of views, and their titles. */
function choices(pane) {
  const scenes = facts.images.map((image, number) => [`scene-${number}`, facts.labels ? image.name : 'Scene']);
  if (pane === 'scene') return scenes;
  const rendered = facts.images.map((image, number) => [`reference-${number}`, facts.labels ? `Reference in the geometry of ${image.name}` : 'Reference in the geometry of the scene']);
  return [...(facts.labels ? [...scenes.slice(1), scenes[0]] : []), ...rendered.filter(([name]) => facts.bands[name]),
    ...facts.maps.map((one, number) => [`map-${number}`, `Reference as a map${facts.maps.length > 1 ? `: ${one.name}` : ''}`])];
}

/** Show a view in a pane. */
function showIn(pane, name) {
  const select = $(`${pane}-shows`);
  select.value = name;
  const title = select.selectedOptions[0].textContent;
  $(`${pane}-title`).textContent = title;
  $(pane).setAttribute('aria-label', `${title}. Arrow keys pan, plus and minus zoom, m measures at the cross in the middle.`);
  views.put(pane, name);
  bandChoices(pane);
  if (pane === 'scene') compare({});
  for (const id of ['flicker', 'difference', 'swipe']) $(id).disabled = !overlay();
  draw();
  return safely(showTiles)([name]);
}

function bandChoices(pane) {
  const select = $(`${pane}-bands`);
  const name = views.shows[pane];
  const count = facts.bands[name];
  /** @type {(...bands: number[]) => [number[], string]} */
  const together = (...bands) => [bands, bands.join(', ')];
  /** @type {[number[], string][]} */
  const offered = [[[0], count > 1 ? 'mean' : '1'], ...(count >= 3 ? [together(1, 2, 3), together(3, 2, 1)] : []),
    ...(count > 1 ? Array.from({ length: count }, (_, index) => together(index + 1)) : [])];
  select.replaceChildren(...offered.map(([, title]) => new Option(title)));
  select.selectedIndex = Math.max(0, offered.findIndex(([bands]) => String(bands) === String(look(name).bands)));
  select.onchange = () => { looks[name] = { bands: offered[select.selectedIndex][0], limits: null }; safely(showTiles)([name]); };
}

function banner() {
  const text = facts.locked ? 'Read-only: these points are open in another ortho measure process. This window shows its changes.'
    : facts.stopped ? `Warning: ${facts.stopped}. Only the points before it are loaded. The other actions are in a .rest file next to the journal.`
    : facts.writes ? (facts.healed ? 'Note: the last action was not saved completely and is lost.' : '') : 'Read-only: these points are open in another window.';
  $('banner-text').textContent = text;
  $('banner').hidden = !text;
  $('take').hidden = facts.locked || facts.writes;
}

/** A read-only window shows the changes of the other one. */
setInterval(async () => {
  if (!facts || facts.writes) return;
  const next = await ask('state').catch(() => null);
  if (next && next.actions !== state.actions && !facts.writes) { show(next); fill(); }
}, 1500);

async function start(given = {}) {
  facts = await ask('begin', given);
  const names = facts.images.map((image) => image.name).join(', ');
  document.title = `${names} – ortho measure`;
  $('title').textContent = `${names} → ${facts.output}`;
  banner();
  if (!views) {
    views = new Views(facts, {
      clicked: (pane, place, hit) => (hit && !pending ? choose(hit) : measure(pane, place)), dragged,
      linked: (at, to, place) => safely(ask)('link', { at, to, place, version: state.version }),
      zoomed: () => { if (state && views.shows.reference) draw(); },
    });
    table = new Table($('table'), choose, Boolean(facts.labels));
    if (facts.labels) $('role').value = 'tie';
    state = facts.state;
    for (const pane of PANES) {
      const select = $(`${pane}-shows`);
      select.replaceChildren(...choices(pane).map(([name, title]) => new Option(title, name)));
      select.hidden = select.options.length < 2;
      $(`${pane}-title`).classList.toggle('hidden', !select.hidden);
      select.addEventListener('change', () => showIn(pane, select.value));
      views.put(pane, select.value);
    }
    $('correction').replaceChildren(new Option(facts.labels ? 'default' : 'shift (default)', ''), ...facts.corrections.map((name) => new Option(name)));
  }
  show(facts.state);
  fill();
  await Promise.all(PANES.map((pane) => showIn(pane, views.shows[pane])));
}

for (const [id, work] of Object.entries({
  undo: () => act({ do: 'undo' }), redo: () => act({ do: 'redo' }), compare: models, make: makeOrtho, help: () => $('keys').showModal(), accept, cancel, off: toggleOff, remove, next: goNext, typed,
  flicker: () => compare({ flicker: !compared.flicker, difference: false }), difference: () => compare({ difference: !compared.difference, flicker: false }), stretch,
  take: () => safely(start)({ take: true }),
})) $(id).addEventListener('click', work);
$('ortho-mix').addEventListener('input', () => { $('ortho-reference').style.opacity = $('ortho-mix').value / 100; });
$('swipe').addEventListener('input', () => compare({ swipe: Number($('swipe').value), flicker: false, difference: false }));
$('correction').addEventListener('change', () => act({ do: 'correct', correction: $('correction').value || null }));
for (const [id, key] of [['name', 'id'], ['role', 'role'], ['note', 'note']]) $(id).addEventListener('change', () => { if (pending) { pending[key] = $(id).value; fill(); } });
for (const [id, key, none] of [['sigma', 'sigma_image', null], ['sigma-xy', 'sigma_xy', 0], ['sigma-h', 'sigma_h', 0]]) {
  $(id).addEventListener('change', safely(async () => { if (pending) pending[key] = decimal(id) ?? none; }));
}
document.addEventListener('keydown', pressed, true);
addEventListener('pagehide', () => navigator.sendBeacon('api/leave', JSON.stringify({ window: windowName })));
safely(start)();
