// Tables of class "sortable": a click, Enter or Space on a heading sorts by its column; the third press brings back
// the order in which the rows came. Links in headings, which sort without this script, give way to it. Numbers are compared by data-value; a cell without one is missing wherever its
// column has any, and missing cells come last in both directions. Without this script the table is a plain table.
(() => {
  "use strict";
  const NEXT = { none: "ascending", ascending: "descending", descending: "none" };

  // The column that each heading stands over, row and column spans counted.
  function columnsOf(head) {
    const taken = Array.from(head.rows, () => []);
    const found = new Map();
    for (const [y, row] of Array.from(head.rows).entries()) {
      let x = 0;
      for (const cell of row.cells) {
        while (taken[y][x]) x += 1;
        found.set(cell, x);
        for (let down = 0; down < cell.rowSpan && y + down < taken.length; down += 1)
          for (let right = 0; right < cell.colSpan; right += 1) taken[y + down][x + right] = true;
        x += cell.colSpan;
      }
    }
    return found;
  }

  function keyOf(row, column) {
    const cell = row.cells[column];
    return cell.dataset.value === undefined ? cell.textContent.trim() : Number(cell.dataset.value);
  }

  function sorted(rows, column, direction) {
    const sign = direction === "descending" ? -1 : 1;
    const keyed = rows.map((row) => ({ row, key: keyOf(row, column) }));
    const numeric = keyed.some(({ key }) => typeof key === "number");
    const missing = (key) => (numeric ? typeof key !== "number" : key === "" || key === "–");
    const compare = (a, b) =>
      missing(a) || missing(b) ? missing(a) - missing(b)
        : sign * (numeric ? a - b : a.localeCompare(b, "en", { numeric: true }));
    return keyed.sort((a, b) => compare(a.key, b.key)).map(({ row }) => row);
  }

  function upgrade(table) {
    const body = table.tBodies[0];
    const original = Array.from(body.rows);
    const heads = Array.from(columnsOf(table.tHead)).filter(([head]) => head.scope === "col" && head.textContent.trim());
    for (const [head, column] of heads) {
      const button = document.createElement("button");
      button.type = "button";
      button.title = "sort by this column";
      button.append(...(head.querySelector("a") ?? head).childNodes);
      head.replaceChildren(button);
      if (!head.hasAttribute("aria-sort")) head.setAttribute("aria-sort", "none");
      button.addEventListener("click", () => {
        const direction = NEXT[head.getAttribute("aria-sort")];
        for (const [other] of heads) other.setAttribute("aria-sort", other === head ? direction : "none");
        body.append(...(direction === "none" ? original : sorted(original, column, direction)));
      });
    }
  }

  document.querySelectorAll("table.sortable").forEach(upgrade);
})();
