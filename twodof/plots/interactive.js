// Decompresses the library and the figures, draws them, and links them to a legend. Its boxes show or hide joints
// and bags in all figures; its columns have the values under the cursor.

import { plotlyContent } from "../../fmu_src/page/unpack.js";

/** @typedef {{bag: number, joint: string, label: string, colour: string, dashes: string}} Row */
/** @typedef {{data: {meta: [number, string, string]}, fullData: {x: ArrayLike<number>}, pointNumber: number, x: number, y: number}} Hovered */
/** @typedef {{data: {meta: [number | null, string, string]}[], layout: object}} Chart */

const ROUNDING = 1e-12; // smaller values are shown as 0
const UNITS_OF = { q: "position", v: "velocity", tau: "effort", residual: "residual", error: "distance" };

/** @param {Row} row @param {() => void} changed @returns {HTMLTableRowElement} a box, a look, a name */
function legendRow(row, changed) {
  const line = document.createElement("tr");
  line.className = row.joint ? "joint" : "bag";
  const label = document.createElement("label");
  const box = document.createElement("input");
  box.type = "checkbox";
  box.checked = true;
  box.onchange = changed;
  const swatch = document.createElement("span");
  swatch.innerHTML = '<svg width="26" height="8"><line x2="26" y1="4" y2="4" stroke-width="2"/></svg>';
  const drawn = /** @type {SVGLineElement} */ (swatch.querySelector("line"));
  drawn.setAttribute("stroke", row.colour);
  drawn.setAttribute("stroke-dasharray", row.dashes);
  label.append(box, swatch, row.label);
  line.insertCell().append(label);
  return line;
}

/** The legend: boxes and cells by bag, joint and quantity. */
class Legend {
  /** @param {Row[]} rows @param {string[]} kinds @param {() => void} changed */
  constructor(rows, kinds, changed) {
    this.table = document.createElement("table");
    this.table.id = "legend";
    const head = this.table.createTHead().insertRow();
    for (const name of ["", ...kinds.map((kind) => UNITS_OF[/** @type {"q"} */ (kind)])]) {
      head.appendChild(document.createElement("th")).textContent = name;
    }
    this.time = /** @type {HTMLElement} */ (head.firstElementChild);
    /** @type {Map<string, HTMLInputElement>} */
    this.boxes = new Map();
    /** @type {Map<string, HTMLTableCellElement>} */
    this.cells = new Map();
    const body = this.table.createTBody();
    for (const row of rows) {
      const line = legendRow(row, changed);
      body.append(line);
      this.boxes.set(`${row.bag} ${row.joint}`, /** @type {HTMLInputElement} */ (line.querySelector("input")));
      for (const kind of kinds) this.cells.set(`${row.bag} ${row.joint} ${kind}`, line.insertCell());
    }
  }

  /** @param {[number | null, string, string]} meta whose a curve is @returns {boolean} */
  shows([bag, joint]) {
    const on = (/** @type {string} */ name) => this.boxes.get(name)?.checked ?? true;
    return bag === null || (on(`${bag} `) && on(`${bag} ${joint}`));
  }

  /** @param {Hovered[]} points under the cursor: of each curve the nearest */
  report(points) {
    for (const cell of this.cells.values()) cell.textContent = "";
    const latest = Math.max(...points.map(({ x }) => x));
    for (const { data, fullData, pointNumber, x, y } of points) {
      if (x < latest && pointNumber === fullData.x.length - 1) continue; // the curve ended earlier
      const cell = this.cells.get(data.meta.join(" "));
      if (cell) cell.textContent = (Math.abs(y) < ROUNDING ? 0 : Number(y)).toPrecision(5).replaceAll("-", "\u2212");
    }
    this.time.textContent = points.length ? `${Number(latest.toPrecision(7))} s` : "";
  }
}

async function drawPlots() {
  /** @type {{figures: Chart[], rows: Row[]}} */
  const { figures, rows } = await plotlyContent();
  const element = /** @type {HTMLElement} */ (document.getElementById("plots"));
  const shown = new Set(figures[0].data.map((trace) => trace.meta[2]));
  const kinds = Object.keys(UNITS_OF).filter((kind) => shown.has(kind));
  const drawn = figures.map(() => Object.assign(document.createElement("div"), { className: "plot" }));
  const legend = new Legend(rows, kinds, () => {
    figures.forEach(({ data }, i) => {
      Plotly.restyle(drawn[i], { visible: data.map((trace) => legend.shows(trace.meta)) });
    });
  });
  const side = Object.assign(document.createElement("div"), { id: "side" });
  side.append(legend.table, ...drawn.slice(1));
  element.append(drawn[0], side);
  const config = { responsive: true, displaylogo: false, doubleClick: "reset", modeBarButtonsToRemove: ["select2d", "lasso2d"] };
  await Promise.all(figures.map(({ data, layout }, i) => Plotly.newPlot(drawn[i], data, layout, config)));
  const hearing = /** @type {any} */ (drawn[0]);
  hearing.on("plotly_hover", (/** @type {any} */ event) => legend.report(event.points));
  hearing.on("plotly_unhover", () => legend.report([]));
  element.dataset.ready = "";
}

drawPlots();
