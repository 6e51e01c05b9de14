// The table of points, sorted by whatever is clicked.

const number = (value, digits = 3) => (value === null || value === undefined ? '–' : value.toFixed(digits));
const length = (pair) => (pair ? Math.hypot(...pair) : null);
const COLUMNS = [
  ['Point', (mark) => mark.id, (mark) => mark.id],
  ['Role', (mark) => mark.role, (mark) => (mark.off ? `${mark.role}, off` : mark.role)],
  ['Column', (mark) => mark.residual?.[0] ?? null, (mark) => number(mark.residual?.[0])],
  ['Row', (mark) => mark.residual?.[1] ?? null, (mark) => number(mark.residual?.[1])],
  ['m', (mark) => length(mark.residual_m), (mark) => number(length(mark.residual_m))],
  ['Left out', (mark) => length(mark.loo), (mark) => number(length(mark.loo))],
  ['w', (mark) => mark.w ?? null, (mark) => number(mark.w, 1)],
  ['By', (mark) => mark.how, (mark) => ({ matched: 'match', manual: 'hand' }[mark.how] ?? mark.how)],
];

export class Table {
  /** @param {HTMLTableElement} table @param {(id: string) => void} chosen */
  constructor(table, chosen) {
    this.body = table.tBodies[0];
    this.chosen = chosen;
    this.by = 0;
    this.down = false;
    this.heads = COLUMNS.map(([name], index) => {
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

  draw(marks, selected) {
    this.marks = marks;
    this.selected = selected;
    const key = COLUMNS[this.by][1];
    const size = (mark) => { const value = key(mark); return typeof value === 'number' ? Math.abs(value) : value; };
    const sorted = [...marks].sort((one, other) => {
      const [first, second] = [size(one), size(other)];
      if (first === null || second === null) return (first === null) - (second === null);
      const order = typeof first === 'number' ? first - second : String(first).localeCompare(String(second), undefined, { numeric: true });
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
      row.append(...COLUMNS.map(([, , text]) => { const cell = document.createElement('td'); cell.textContent = text(mark); return cell; }));
      row.addEventListener('click', () => this.chosen(mark.id));
      row.addEventListener('keydown', (event) => { if (event.key === 'Enter') { event.stopPropagation(); this.chosen(mark.id); } });
      return row;
    }));
  }
}
