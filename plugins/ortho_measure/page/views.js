// Two panes, each shows a named view: `scene-K` is image K, `reference-K` the reference rendered into its pixels, `map-R`
// reference R in its own pixels. Panes with the same geometry share an OpenLayers view, so they pan and zoom together. With
// two geometries, one pane follows the other by their relation at the middle. A pixel (column, row) is at (column, -row) in OpenLayers.
/* global ol */

const SHAPES = { control: 3, check: 0, tie: 4 };
const COLOURS = { control: '#ffb000', check: '#35c3ff', tie: '#8be04e' };
/** @param {Pair} place */
const at = ([column, row]) => [column, -row];
/** @param {Pair} place */
export const pixel = ([x, y]) => [x, -y];
/** The geometry of a view. */
export const geometryOf = (name) => name.replace(/^reference-/, 'scene-');
export const PANES = ['scene', 'reference'];

/** Tiles of one view in one rendering; `show` gives them another rendering, bands or contrast. */
function tiled(name, size, tile, projection) {
  const resolutions = [1];
  while (Math.max(...size) / resolutions[0] > tile) resolutions.unshift(resolutions[0] * 2);
  const grid = new ol.tilegrid.TileGrid({ origin: [0, 0], extent: [0, -size[1], size[0], 0], resolutions, tileSize: tile });
  const source = new ol.source.TileImage({ projection, tileGrid: grid, transition: 0, interpolate: false, url: '' });
  return {
    source,
    show({ version, bands, limits }) {
      const query = `b=${bands.join(',')}&l=${limits.flat().join(',')}`;
      source.setTileUrlFunction(([z, x, y]) => (x < 0 || y < 0 ? undefined
        : `tiles/${name}/${version}/${resolutions[z]}/${x}/${y}?${query}`), `${version}?${query}`);
    },
  };
}

/** Symbol of a point; dashed if it was predicted, not measured. */
function symbol(mark, selected, expected) {
  const off = mark.off || expected;
  const stroke = new ol.style.Stroke({ color: mark.suspicious ? '#ff3b1f' : COLOURS[mark.role], width: selected ? 4 : 2, lineDash: expected ? [3, 4] : undefined });
  const fill = new ol.style.Fill({ color: off ? 'rgba(0,0,0,0)' : 'rgba(0,0,0,.35)' });
  const points = SHAPES[mark.role];
  return new ol.style.Style({
    image: points ? new ol.style.RegularShape({ points, radius: 9, stroke, fill, angle: points === 4 ? Math.PI / 4 : 0 })
      : new ol.style.Circle({ radius: 7, stroke, fill }),
    text: new ol.style.Text({ text: mark.id, offsetY: -16, font: '600 12px system-ui, sans-serif', fill: new ol.style.Fill({ color: '#fff' }),
      stroke: new ol.style.Stroke({ color: '#000', width: 3 }) }),
  });
}

const line = (color, width, lineDash) => new ol.style.Style({ stroke: new ol.style.Stroke({ color, width, lineDash }) });
const CROSS = [new ol.style.Style({ image: new ol.style.RegularShape({ points: 4, radius: 11, radius2: 0, stroke: new ol.style.Stroke({ color: '#000', width: 4 }) }) }),
  new ol.style.Style({ image: new ol.style.RegularShape({ points: 4, radius: 11, radius2: 0, stroke: new ol.style.Stroke({ color: '#ff4fd8', width: 2 }) }) })];
const NEXT = new ol.style.Style({ image: new ol.style.Circle({ radius: 16, stroke: new ol.style.Stroke({ color: '#fff', width: 2, lineDash: [5, 5] }) }) });

export class Views {
  /**
   * @param {Facts} facts
   * @param {{clicked: (pane: string, place: number[], hit: string|null) => void, dragged: (pane: string, id: string, place: number[]) => void,
   *   linked: (at: string, to: string, place: number[]) => Promise<{place: number[]|null, matrix: number[][]|null}|undefined>, zoomed: () => void}} told
   */
  constructor(facts, told) {
    this.facts = facts;
    this.told = told;
    this.geometries = {};
    this.tiles = {};
    this.shows = {};
    this.maps = {};
    this.marks = {};
    this.loupes = {};
    this.base = {};
    this.link = null; // {lead, from, to, matrix}: how the pane that leads lies in the other one
    this.lead = 'scene';
    this.turn = 0;
    this.over = new ol.layer.Tile({ visible: false });
    this.swipe = 0;
    this.difference = false;
    this.over.on('prerender', (event) => this.#clip(event));
    this.over.on('postrender', (event) => { event.context.restore(); });
    for (const pane of PANES) {
      this.marks[pane] = new ol.source.Vector();
      this.base[pane] = new ol.layer.Tile({});
      const layers = [this.base[pane], ...(pane === 'scene' ? [this.over] : []),
        new ol.layer.Vector({ source: this.marks[pane], updateWhileAnimating: true, updateWhileInteracting: true })];
      // The wheel and a drag work in whichever pane the pointer is, without a click before.
      const map = new ol.Map({ target: pane, controls: [], layers, interactions: ol.interaction.defaults.defaults({ onFocusOnly: false }) });
      map.on('click', (event) => {
        const hit = map.forEachFeatureAtPixel(event.pixel, (feature) => feature.getId() ?? null, { hitTolerance: 4 });
        document.getElementById(pane).focus();
        told.clicked(pane, pixel(event.coordinate), hit ?? null);
      });
      map.on('moveend', () => { if (pane === this.lead) this.relink(); });
      const drag = new ol.interaction.Translate({ filter: (feature) => feature.getId() !== undefined, hitTolerance: 4 });
      drag.on('translateend', (event) => event.features.forEach((feature) => told.dragged(pane, feature.getId(), pixel(feature.getGeometry().getCoordinates()))));
      map.addInteraction(drag);
      this.maps[pane] = map;
      this.loupes[pane] = new ol.Map({ target: `loupe-${pane}`, controls: [], interactions: [], layers: [new ol.layer.Tile({})] });
    }
  }

  /** What is shown in: pixels of an image or of a map, with the view that panes of this geometry share. */
  #geometry(name) {
    const [kind, number] = name.split('-');
    return this.geometries[name] ??= (() => {
      const [width, height] = (kind === 'map' ? this.facts.maps : this.facts.images)[number].size;
      const extent = [0, -height, width, 0];
      const projection = new ol.proj.Projection({ code: name, units: 'pixels', extent });
      const view = new ol.View({ projection, center: [width / 2, -height / 2], minResolution: 1 / 32,
        maxResolution: Math.max(width, height) / 250, resolution: 1, enableRotation: false, smoothExtentConstraint: false });
      view.on(['change:center', 'change:resolution'], () => this.#moved(name));
      // Vectors of residuals are as long on the screen at every zoom.
      view.on('change:resolution', () => this.told.zoomed());
      return { size: [width, height], extent, projection, view };
    })();
  }

  /** Tiles of a view by its name. */
  of(name) {
    const { size, projection } = this.#geometry(geometryOf(name));
    return this.tiles[name] ??= tiled(name, size, this.facts.tile, projection);
  }

  view(pane) { return this.#geometry(geometryOf(this.shows[pane])).view; }

  /** Show a view in a pane. */
  put(pane, name) {
    const before = this.shows[pane];
    this.shows[pane] = name;
    const { extent, projection, view, size } = this.#geometry(geometryOf(name));
    const source = this.of(name).source;
    for (const layer of [this.base[pane], this.loupes[pane].getLayers().item(0)]) {
      layer.setSource(source);
      layer.setExtent(extent); // tiles reach beyond the scene, where the reference goes on
    }
    if (pane === 'scene') this.over.setExtent(extent);
    this.maps[pane].setView(view);
    this.loupes[pane].setView(new ol.View({ projection, center: at([size[0] / 2, size[1] / 2]), resolution: 1 / 6, enableRotation: false }));
    if (before === undefined) this.whole(pane);
    // What was looked at stays in the other pane, and this one goes there.
    this.lead = PANES.find((other) => other !== pane);
    this.link = null;
    if (this.shows[this.lead]) this.relink();
  }

  /** Whether both panes are in one geometry. */
  get together() { return geometryOf(this.shows.scene) === geometryOf(this.shows.reference); }

  /** Ask anew how the pane that leads lies in the other one, and let this one follow. */
  async relink() {
    const mine = (this.turn += 1);
    if (this.together) { this.link = null; return; }
    const { lead } = this;
    const other = PANES.find((pane) => pane !== lead);
    const from = this.middle(lead);
    const found = await this.told.linked(this.shows[lead], this.shows[other], from);
    if (mine !== this.turn) return;
    this.link = found?.place ? { lead, from, to: found.place, matrix: found.matrix } : null;
    this.#follow();
  }

  /** A view was moved, by a person or by what follows. */
  #moved(geometry) {
    if (this.following || !this.shows.reference || this.together) return;
    const pane = PANES.find((one) => geometryOf(this.shows[one]) === geometry);
    if (!pane) return;
    if (this.lead !== pane) {
      this.lead = pane;
      if (this.link) {
        const [[a, b], [c, d]] = this.link.matrix;
        const size = a * d - b * c;
        this.link = { lead: pane, from: this.link.to, to: this.link.from, matrix: [[d / size, -b / size], [-c / size, a / size]] };
      }
    }
    this.#follow();
  }

  #follow() {
    if (!this.link) return;
    const { lead, from, to, matrix: [[a, b], [c, d]] } = this.link;
    const follower = this.view(PANES.find((pane) => pane !== lead));
    const [column, row] = this.middle(lead).map((value, axis) => value - from[axis]);
    this.following = true;
    follower.setResolution(this.view(lead).getResolution() * Math.sqrt(Math.abs(a * d - b * c)));
    follower.setCenter(at([to[0] + a * column + b * row, to[1] + c * column + d * row]));
    this.following = false;
  }

  #clip(event) {
    const context = event.context;
    context.save();
    if (this.swipe > 0) {
      const width = context.canvas.width * (1 - this.swipe / 100);
      context.beginPath();
      context.rect(width, 0, context.canvas.width - width, context.canvas.height);
      context.clip();
    }
    if (this.difference) context.globalCompositeOperation = 'difference';
  }

  /** Show a view of the same geometry in the scene's own pane: as a whole, right of a handle, or as a difference. */
  compare(name, { flicker, swipe, difference }) {
    this.swipe = flicker || difference ? 0 : swipe;
    this.difference = difference;
    if (name) this.over.setSource(this.of(name).source);
    this.over.setVisible(Boolean(name) && (flicker || difference || swipe > 0));
    this.maps.scene.render();
  }

  /**
   * Draw marks with their residuals, the point under way, and the next place.
   * @param {(mark: object, name: string) => {place: number[]|null, residual?: number[]|null, expected?: boolean}} placed where a mark is in a view
   */
  draw(marks, selected, pending, next, placed) {
    for (const pane of PANES) {
      const name = this.shows[pane];
      const source = this.marks[pane];
      source.clear(true);
      const features = [];
      const all = marks.map((mark) => [mark, placed(mark, name)]);
      const extent = Math.max(...all.map(([, { residual }]) => (residual ? Math.hypot(...residual) : 0)), 0);
      for (const [mark, { place, residual, expected }] of all) {
        if (!place) continue;
        if (residual && extent > 0) {
          // The longest vector is as long as 60 px of the screen.
          const scale = 60 / extent * this.view(pane).getResolution();
          const end = [place[0] + residual[0] * scale, place[1] + residual[1] * scale];
          const vector = new ol.Feature(new ol.geom.LineString([at(place), at(end)]));
          vector.setStyle([line('#000', 4), line(mark.suspicious ? '#ff3b1f' : '#ffe600', 2)]);
          features.push(vector);
        }
        const feature = new ol.Feature(new ol.geom.Point(at(place)));
        if (!expected) feature.setId(mark.id);
        feature.setStyle(symbol(mark, mark.id === selected, expected));
        features.push(feature);
      }
      const { place } = pending ? placed(pending, name) : { place: null };
      if (place) { const feature = new ol.Feature(new ol.geom.Point(at(place))); feature.setStyle(CROSS); features.push(feature); }
      const ahead = next?.places[name];
      if (ahead) { const feature = new ol.Feature(new ol.geom.Point(at(ahead))); feature.setStyle(NEXT); features.push(feature); }
      source.addFeatures(features);
      if (place) this.loupes[pane].getView().setCenter(at(place));
    }
  }

  /** What is in the middle of a pane. */
  middle(pane) { return pixel(this.view(pane).getCenter()); }

  /** Go to a place in whichever pane shows it; the other one follows. */
  goTo(places, resolution) {
    const pane = PANES.find((one) => places[this.shows[one]]);
    if (!pane) return;
    this.lead = pane;
    const view = this.view(pane);
    view.setCenter(at(places[this.shows[pane]]));
    if (resolution && view.getResolution() > resolution) view.setResolution(resolution);
  }

  /** Show the whole of a pane's view. */
  whole(pane) { this.view(pane).fit(this.#geometry(geometryOf(this.shows[pane])).extent, { size: this.maps[pane].getSize() }); }

  /** What is seen in a pane: left, top, right, bottom. */
  box(pane) {
    const [left, low, right, high] = this.view(pane).calculateExtent(this.maps[pane].getSize());
    return [left, -high, right, -low];
  }
}
