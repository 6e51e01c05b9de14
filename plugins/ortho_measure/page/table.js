// The table of points, sorted by the column that is clicked.

const number = (value, digits = 3) => (value === null || value === undefined ? '–' : value.toFixed(digits).replace(/^-(0\.?0*)$/, '$1'));
const length = (pair) => (pair ? Math.hypot(...pair) : null);
/** A heading, what it sorts by, and what a cell shows. @typedef {[string, (mark: Shown) => string|number|null, (mark: Shown) => string]} Column */

/** @type {Column[]} */
const ONE = [
  ['Point', (mark) => mark.id, (mark) => mark.id],
  ['Role', (mark) => mark.role, (mark) => (mark.off ? `${mark.role}, off` : mark.role)],
  ['Col., px', (mark) => mark.residual?.[0] ?? null, (mark) => number(mark.residual?.[0])],
  ['Row, px', (mark) => mark.residual?.[1] ?? null, (mark) => number(mark.residual?.[1])],
  ['Ground, m', (mark) => length(mark.residual_m), (mark) => number(length(mark.residual_m))],
  ['Left out, px', (mark) => length(mark.loo), (mark) => number(length(mark.loo))],
  ['w', (mark) => mark.w ?? null, (mark) => number(mark.w, 1)],
  ['How', (mark) => mark.how, (mark) => (methods[mark.how] ?? mark.how)],
];

const methods = { matched: 'match', manual: 'click' };
const rays = (mark) => Object.values(mark.rays ?? {});
/** How many rays there are by each method: 2 match, 1 click. */
function counted(mark) {
  const found = {};
  for (const { how } of rays(mark)) found[methods[how] ?? how] = (found[methods[how] ?? how] ?? 0) + 1;
  return Object.entries(found).map(([how, count]) => `${count} ${how}`).join(', ');
}
const longest = (of) => { const found = Object.values(of ?? {}).map(length).filter((value) => value !== null); return found.length ? Math.max(...found) : null; };
const plan = (values) => (values && values[0] !== null && values[1] !== null ? Math.hypot(values[0], values[1]) : null);
/** @type {Column[]} */
const SEVERAL = [
  ['Point', (mark) => mark.id, (mark) => mark.id],
  ['Role', (mark) => mark.role, (mark) => (mark.off ? `${mark.role}, off` : mark.role)],
  ['Rays', (mark) => rays(mark).length, counted],
  ['px', (mark) => longest(mark.residuals), (mark) => number(longest(mark.residuals), 2)],
  ['Left out, px', (mark) => longest(mark.loo), (mark) => number(longest(mark.loo), 2)],
  ['Plan, m', (mark) => plan(mark.loo_m), (mark) => number(plan(mark.loo_m), 2)],
  ['h, m', (mark) => mark.loo_m?.[2] ?? null, (mark) => number(mark.loo_m?.[2], 2)],
  ['± h, m', (mark) => mark.sigma_m?.[2] ?? null, (mark) => number(mark.sigma_m?.[2], 2)],
  ['w', (mark) => mark.w ?? null, (mark) => number(mark.w, 1)],
];

export class Table {
  /** @param {HTMLTableElement} table @param {(id: string) => void} chosen @param {boolean} several images */
  constructor(table, chosen, several) {
    this.columns = several ? SEVERAL : ONE;
    this.body = table.tBodies[0];
    this.chosen = chosen;
    this.by = 0;
    this.down = false;
    this.heads = this.columns.map(([name], index) => {
      const head = document.createElement('th');
      head.scope = 'col';
      const button = document.createElement('button');
      button.textContent = name;
      button.addEventListener('click', () => { this.down = this.by === index && !this.down; this.by = index; this.draw(this.marks, this.selected); });
      head.append(button);
      return head;
    });
    const row = document.createElement('tr');
    row.append(...this.heads);
    table.tHead.replaceChildren(row);
  }

  /** @param {Shown[]} marks @param {string|null} selected */
  draw(marks, selected) {
    this.marks = marks;
    this.selected = selected;
    const key = this.columns[this.by][1];
    const size = (mark) => { const value = key(mark); return typeof value === 'number' ? Math.abs(value) : value; };
    const sorted = [...marks].sort((one, other) => {
      const [first, second] = [size(one), size(other)];
      if (first === null || second === null) return Number(first === null) - Number(second === null);
      const order = typeof first === 'number' && typeof second === 'number' ? first - second : String(first).localeCompare(String(second), undefined, { numeric: true });
      return this.down ? -order : order;
    });
    this.order = sorted.map((mark) => mark.id);
    this.heads.forEach((head, index) => head.setAttribute('aria-sort', index !== this.by ? 'none' : this.down ? 'descending' : 'ascending'));
    this.body.replaceChildren(...sorted.map((mark) => {
      const row = document.createElement('tr');
      row.tabIndex = 0;
      row.dataset.id = mark.id;
      row.setAttribute('aria-selected', String(mark.id === selected));
      row.className = [mark.off ? 'off' : '', mark.suspicious ? 'doubt' : ''].join(' ');
      if (mark.reason) row.title = mark.reason;
      row.append(...this.columns.map(([, , text]) => { const cell = document.createElement('td'); cell.textContent = text(mark); return cell; }));
      row.addEventListener('click', () => this.chosen(mark.id));
      row.addEventListener('keydown', (event) => { if (event.key === 'Enter') { event.stopPropagation(); this.chosen(mark.id); } });
      return row;
    }));
  }
}
