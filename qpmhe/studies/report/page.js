"use strict";
// Shows the chosen problem, hides backends in figures and table, and sorts the table.
(() => {
  const hidden = new Set();
  const problem = document.getElementById("case");
  const buttons = [...document.querySelectorAll("button.backend")];
  const table = document.getElementById("configurations");

  function refresh() {
    for (const one of document.querySelectorAll("[data-case]")) {
      one.hidden = problem && one.dataset.case !== problem.value;
    }
    for (const section of document.querySelectorAll("section.drawn")) {
      section.hidden = !section.querySelector(".plot:not([hidden])");
    }
    for (const one of document.querySelectorAll("g[data-backend]")) {
      one.style.display = hidden.has(one.dataset.backend) ? "none" : "";
    }
    for (const row of table.tBodies[0].rows) { row.hidden ||= hidden.has(row.dataset.backend); }
    for (const button of buttons) {
      button.setAttribute("aria-pressed", String(!hidden.has(button.dataset.backend)));
    }
  }

  // Numbers by what the cell says of their rank, texts by the alphabet; a second click reverses.
  for (const heading of table.tHead.rows[0].cells) {
    heading.addEventListener("click", () => {
      const sign = heading.ariaSort === "ascending" ? -1 : 1, place = heading.cellIndex;
      const rank = (row) => row.cells[place].dataset.rank ?? row.cells[place].textContent;
      const rows = [...table.tBodies[0].rows].sort((one, two) => {
        const [a, b] = [rank(one), rank(two)], difference = a - b;
        return sign * (Number.isNaN(difference) ? a === b ? 0 : a.localeCompare(b) : difference);
      });
      for (const other of table.tHead.rows[0].cells) { other.ariaSort = null; }
      heading.ariaSort = sign > 0 ? "ascending" : "descending";
      table.tBodies[0].append(...rows);
    });
  }

  for (const button of buttons) {
    button.addEventListener("click", () => {
      const name = button.dataset.backend;
      if (!hidden.delete(name)) { hidden.add(name); }
      refresh();
    });
  }
  document.getElementById("all").addEventListener("click", () => { hidden.clear(); refresh(); });
  document.getElementById("none").addEventListener("click", () => {
    buttons.forEach((one) => hidden.add(one.dataset.backend));
    refresh();
  });
  problem?.addEventListener("change", refresh);
  refresh();
})();
