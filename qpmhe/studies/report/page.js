"use strict";
// Draws the figures of the chosen problem, and hides in all of them what the filters hide.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const hidden = new Set();
  // The table's own styles look for this class.
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const shade = () => document.documentElement.classList.toggle("dark", dark.matches);
  dark.addEventListener("change", shade);
  shade();
  const wanted = {};            // figure -> what its own menus choose
  const drawn = {};             // figure -> the JSON that is on screen
  // Where no pointer hovers the bar would always be there, and on narrow pages over the legend.
  const roomy = matchMedia("(hover: hover) and (min-width: 600px)").matches;
  const config = { responsive: true, displaylogo: false, displayModeBar: roomy ? "hover" : false,
    modeBarButtonsToRemove: ["toImage", "select2d", "lasso2d", "autoScale2d"] };
  const problem = document.getElementById("case");
  const current = () => (problem ? problem.value : Object.keys(data.cases)[0]);
  const menus = [...document.querySelectorAll("select[data-figure]")];
  const plots = [...document.querySelectorAll(".plot")];

  function figure(name) {
    const found = data.cases[current()][name];
    return name === "accuracy" && found ? found[wanted.accuracy.metric] : found;
  }

  function shows(trace, choice) {
    const meta = trace.meta || {};
    return !hidden.has(meta.backend)
      && (meta.qps === undefined || meta.qps === choice.qps)
      && (meta.cap === undefined || meta.cap === choice.cap)
      && (meta.start === undefined || meta.start === choice.start);
  }

  // Menus keep their choice from problem to problem where there is such an entry.
  function fill() {
    for (const menu of menus) {
      const name = menu.dataset.figure, key = menu.dataset.key;
      wanted[name] ??= {};
      const entries = (data.cases[current()].menus[name] || {})[key];
      if (entries) {
        const before = wanted[name][key] ?? data.cases[current()].defaults[key];
        menu.replaceChildren(...entries.map(([value, text]) => new Option(text, value)));
        menu.parentElement.hidden = key === "start" && entries.length < 2;
        if (entries.some(([value]) => value === before)) { menu.value = before; }
      }
      wanted[name][key] = menu.value;
    }
  }

  function draw(plot) {
    const name = plot.dataset.figure, found = figure(name), choice = wanted[name] || {};
    // A section without data for this problem is left out.
    plot.closest("section").hidden = !found;
    if (!found) {
      Plotly.purge(plot);
      drawn[name] = null;
      return;
    }
    const traces = found.data.map((trace) => ({ ...trace, visible: shows(trace, choice) }));
    if (name === "trajectories") { follow(traces, choice.run); }
    const layout = structuredClone(found.layout);
    // A zoom survives the filters, but not another problem or measure.
    layout.uirevision = `${current()}/${choice.metric || choice.run || ""}`;
    drawn[name] = found;
    Plotly.react(plot, traces, layout, config);
  }

  function follow(traces, key) {
    const runs = data.cases[current()].runs;
    for (const trace of traces) {
      const { role, state } = trace.meta;
      const run = role === "observer" ? runs.observer : role === "estimate" ? runs.all[key] : null;
      if (run) { trace.y = run[state]; }
      if (role === "observer") { trace.visible = Boolean(run); }
    }
  }

  function filterTable() {
    const table = window.configurationTable;
    if (!table) { return; }
    const backend = data.columns.backend, place = data.columns.case;
    table.search.fixed("page", (_, row) => !hidden.has(row[backend]) && row[place] === current())
      .draw();
  }

  // What is left and right of the table's visible part shows by shadows, and by the button.
  function watchSides() {
    const section = document.getElementById("table");
    const body = section.querySelector(".dt-scroll-body");
    if (!body) { return; }
    const look = () => {
      section.classList.toggle("scrolled", body.scrollLeft > 1);
      section.classList.toggle("more", body.scrollLeft + body.clientWidth < body.scrollWidth - 1);
    };
    body.addEventListener("scroll", look);
    new ResizeObserver(look).observe(body);
    window.configurationTable.on("draw", look);
    document.getElementById("further").addEventListener("click",
      () => body.scrollBy({ left: 0.7 * body.clientWidth }));
    look();
  }

  function refresh() {
    for (const button of document.querySelectorAll("button.backend")) {
      button.setAttribute("aria-pressed", String(!hidden.has(button.dataset.backend)));
    }
    plots.forEach(draw);
    filterTable();
  }

  for (const button of document.querySelectorAll("button.backend")) {
    button.addEventListener("click", () => {
      const name = button.dataset.backend;
      if (!hidden.delete(name)) { hidden.add(name); }
      refresh();
    });
  }
  const every = [...document.querySelectorAll("button.backend")].map((one) => one.dataset.backend);
  document.getElementById("all").addEventListener("click", () => { hidden.clear(); refresh(); });
  document.getElementById("none").addEventListener("click", () => {
    every.forEach((name) => hidden.add(name));
    refresh();
  });
  for (const menu of menus) {
    menu.addEventListener("change", () => {
      wanted[menu.dataset.figure][menu.dataset.key] = menu.value;
      plots.filter((plot) => plot.dataset.figure === menu.dataset.figure).forEach(draw);
    });
  }
  problem?.addEventListener("change", () => {
    for (const list of document.querySelectorAll("[data-case]")) {
      list.hidden = list.dataset.case !== current();
    }
    fill();
    refresh();
  });
  window.addEventListener("configurationTable", filterTable);
  window.addEventListener("configurationTable", watchSides);
  if (window.configurationTable) { watchSides(); }
  fill();
  refresh();
})();
