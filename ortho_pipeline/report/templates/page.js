"use strict";
/* Sorting, filtering and highlighting. The page has every number, chip and plot without it. */
(() => {
  const value = (row, column) => row.cells[column]?.textContent.trim() ?? "";
  const number = (text) => Number.parseFloat(text.replace(/\u2212/g, "-").replace(/[,\u2009]/g, ""));

  for (const table of document.querySelectorAll("table.sorts")) {
    const head = table.tHead.rows[table.tHead.rows.length - 1];
    const body = table.tBodies[0];
    [...head.cells].forEach((cell, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...cell.childNodes);
      cell.append(button);
      button.addEventListener("click", () => {
        const down = cell.getAttribute("aria-sort") === "ascending";
        for (const other of head.cells) other.removeAttribute("aria-sort");
        cell.setAttribute("aria-sort", down ? "descending" : "ascending");
        const key = (row) => {
          const text = value(row, column);
          const found = number(text);
          return Number.isNaN(found) ? [text === "\u2013" ? 2 : 1, text] : [0, found];
        };
        const rows = [...body.rows].map((row) => [key(row), row]);
        rows.sort(([[kind, a]], [[other, b]]) => {
          if (kind !== other) return kind - other;
          const order = kind === 0 ? a - b : String(a).localeCompare(String(b), undefined, { numeric: true });
          return down ? -order : order;
        });
        body.append(...rows.map(([, row]) => row));
      });
    });
    if (body.rows.length < 8) continue;
    const label = document.createElement("label");
    label.className = "filter";
    const input = document.createElement("input");
    input.type = "search";
    const count = document.createElement("span");
    count.setAttribute("role", "status");
    label.append("Show rows with ", input, " ", count);
    input.addEventListener("input", () => {
      const wanted = input.value.trim().toLowerCase();
      let shown = 0;
      for (const row of body.rows) {
        row.hidden = !row.textContent.toLowerCase().includes(wanted);
        shown += row.hidden ? 0 : 1;
      }
      count.textContent = wanted ? `${shown} of ${body.rows.length}` : "";
    });
    (table.closest(".scroll") ?? table).before(label);
  }

  const parts = new Map();
  for (const part of document.querySelectorAll("[data-point]")) {
    const key = part.dataset.point;
    if (!parts.has(key)) parts.set(key, []);
    parts.get(key).push(part);
    const light = (on) => () => parts.get(key).forEach((one) => one.classList.toggle("lit", on));
    part.addEventListener("pointerenter", light(true));
    part.addEventListener("pointerleave", light(false));
    part.addEventListener("focusin", light(true));
    part.addEventListener("focusout", light(false));
    if (part instanceof SVGGElement) {
      part.addEventListener("click", () => {
        const row = parts.get(key).find((one) => one.tagName !== "g");
        row?.scrollIntoView({ block: "center" });
      });
    }
  }
})();
