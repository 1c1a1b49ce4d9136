// Draws a sweep: two maps side by side, a Pareto front of two metrics, and the data of the clicked run.

import { plotlyContent } from "../../fmu_src/page/unpack.js";

/** @typedef {{varied: string[], metrics: Record<string, string>, units: Record<string, string>, columns: Record<string, (number | null)[]>, outcome: string[], beyond: boolean[], best: number[], again: string[], quoted: Record<string, string>, curves: Record<string, {verdict: string, lines: Record<string, [number[], number[]]>}>}} Sweep */

const dark = matchMedia("(prefers-color-scheme: dark)");

/** @returns {any} common layout of all charts, in the page's colours */
function layout() {
  const [ink, hair] = dark.matches ? ["#d5dade", "#3a4046"] : ["#1f2933", "#e6e9ec"];
  const axis = { gridcolor: hair, linecolor: hair, zeroline: false, automargin: true, exponentformat: "power" };
  return {
    font: { family: "sans-serif", size: 12, color: ink }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    margin: { l: 50, r: 10, t: 10, b: 44 }, height: 340, showlegend: false, hovermode: "closest", xaxis: axis, yaxis: axis,
  };
}

class SweepPage {
  /** @param {Sweep} sweep @param {HTMLElement} element */
  constructor(sweep, element) {
    this.sweep = sweep;
    this.runs = /** @type {number[]} */ (sweep.columns.run);
    this.chosen = Math.max(0, this.runs.indexOf(sweep.best[0] ?? -1));
    const names = Object.keys(sweep.metrics), every = [...sweep.varied, ...names];
    const [x, y] = [sweep.varied[0], sweep.varied[1] ?? names[0]];
    this.charts = [
      this.chart(element, "map", [x, y, names[0]], [sweep.varied, every, names]),
      this.chart(element, "map", [x, y, names.includes("peak_effort") ? "peak_effort" : names[names.length - 1]], [sweep.varied, every, names]),
      this.chart(element, "front", [names[0], names.includes("peak_effort") ? "peak_effort" : names[1] ?? names[0]], [names, names]),
    ];
    this.detail = element.appendChild(Object.assign(document.createElement("section"), { className: "run" }));
    this.curve = document.createElement("div");
    this.draw();
    dark.addEventListener("change", () => this.draw());
  }

  /** @param {string} name @returns {string} with its unit */
  title(name) {
    const unit = this.sweep.units[name];
    return (this.sweep.metrics[name] ?? name) + (unit ? `, ${unit.replace(".", "·")}` : "");
  }

  /** @param {HTMLElement} element @param {string} kind @param {string[]} shown @param {string[][]} choices */
  chart(element, kind, shown, choices) {
    const box = element.appendChild(document.createElement("section")), head = box.appendChild(document.createElement("p"));
    const words = kind === "front" ? ["Pareto front of", "and"] : ["across", "up", "colour"];
    shown.forEach((name, i) => {
      const label = head.appendChild(document.createElement("label")), select = document.createElement("select");
      select.append(...choices[i].map((each) => new Option(this.sweep.metrics[each] ?? each, each, each === name, each === name)));
      select.onchange = () => { shown[i] = select.value; this.draw(); };
      label.append(`${words[i]} `, select);
    });
    return { kind, shown, div: box.appendChild(document.createElement("div")) };
  }

  /** @param {string[]} names @returns {boolean[]} runs on the Pareto front of two metrics */
  front([first, second]) {
    const { columns, outcome, beyond } = this.sweep, a = columns[first], b = columns[second];
    const fit = this.runs.map((_, k) => k).filter((k) => a[k] !== null && b[k] !== null && outcome[k] === "finished" && !beyond[k]);
    fit.sort((i, j) => Number(a[i]) - Number(a[j]) || Number(b[i]) - Number(b[j]));
    const found = this.runs.map(() => false);
    let least = Infinity;
    for (const k of fit) if (Number(b[k]) < least) { found[k] = true; least = Number(b[k]); }
    return found;
  }

  draw() {
    for (const chart of this.charts) {
      const { kind, shown, div } = chart, { columns, beyond } = this.sweep, base = layout();
      const [x, y] = [columns[shown[0]], columns[shown[1]]], pick = this.chosen;
      const at = (/** @type {boolean[]} */ on) => [x.filter((_, k) => on[k]), y.filter((_, k) => on[k])];
      const [bx, by] = at(beyond), dense = this.runs.length > 100 ? 9 : 14;
      const text = this.runs.map((run, k) => `run ${run}${beyond[k] ? ", not possible on this robot" : ""}`);
      /** @type {any} */
      const dots = { type: "scatter", mode: "markers", x, y, text, marker: { size: dense, symbol: "square" } };
      const crosses = { type: "scatter", mode: "markers", x: bx, y: by, hoverinfo: "skip", marker: { symbol: "x-thin", size: 6, line: { width: 1.5, color: "#D55E00" } } };
      const ring = { type: "scatter", mode: "markers", x: [x[pick]], y: [y[pick]], hoverinfo: "skip", marker: { symbol: "circle-open", size: 18, color: "#D55E00", line: { width: 3 } } };
      const traces = [dots, crosses, ring];
      if (kind === "map") {
        const color = columns[shown[2]];
        const symbol = color.map((value) => (value === null ? "square-open" : "square"));
        if (dark.matches) base.plot_bgcolor = "#8a9299"; // on which both ends of the colours are seen
        Object.assign(dots.marker, { color, symbol, colorscale: "Viridis", showscale: true, colorbar: { thickness: 10, outlinewidth: 0 } });
        dots.hovertemplate = `%{text}<br>${shown[0]} %{x}<br>${shown[1]} %{y}<br>%{marker.color:.4g}<extra></extra>`;
      } else {
        const on = this.front(shown), [fx, fy] = at(on), order = fx.map((_, i) => i).sort((i, j) => Number(fx[i]) - Number(fx[j]));
        Object.assign(dots.marker, { color: "#8a97a3", symbol: "circle", size: 6 });
        traces.splice(1, 0, { type: "scatter", mode: "lines+markers", x: order.map((i) => fx[i]), y: order.map((i) => fy[i]), hoverinfo: "skip", line: { shape: "hv", color: "#0072B2" } });
      }
      base.xaxis = { ...base.xaxis, title: { text: this.title(shown[0]) } };
      base.yaxis = { ...base.yaxis, title: { text: this.title(shown[1]) } };
      Plotly.react(div, traces, base, { responsive: true, displayModeBar: false });
      const map = /** @type {any} */ (div);
      map.removeAllListeners("plotly_click");
      map.on("plotly_click", (/** @type {any} */ event) => {
        const point = event.points.find((/** @type {any} */ each) => each.curveNumber === 0);
        if (!point) return;
        this.chosen = point.pointNumber;
        this.draw();
      });
    }
    this.describe();
  }

  /** Show the selected run: its numbers, the command that repeats it, and its curves, if it has a bag. */
  describe() {
    const { columns, outcome, beyond, varied, metrics, curves, again, quoted } = this.sweep, k = this.chosen, run = this.runs[k];
    const number = (/** @type {string} */ name) => Number(columns[name][k]).toPrecision(4);
    const known = Object.keys(metrics).filter((name) => columns[name][k] !== null);
    const lines = [
      `run ${run}: ${varied.map((name) => `${name} = ${number(name)}`).join(", ")}; ${outcome[k]}${beyond[k] ? "; not possible on this robot: beyond the URDF's limits" : ""}`,
      known.map((name) => `${this.title(name)}: ${number(name)}`).join("; "), curves[run]?.verdict ?? "",
    ];
    const command = [...again, ...varied.map((name) => `--set ${quoted[name]}=${columns[name][k]}`)].join(" ");
    const code = document.createElement("code"); // no line begins within an option
    code.append(...command.split(" ").flatMap((word) => [Object.assign(document.createElement("span"), { textContent: word }), " "]));
    this.detail.replaceChildren(...lines.filter(Boolean).map((text) => Object.assign(document.createElement("p"), { textContent: text })), code, this.curve);
    const drawn = Object.entries(curves[run]?.lines ?? {});
    this.curve.hidden = !drawn.length;
    if (!drawn.length) return;
    const base = { ...layout(), showlegend: true, height: 420, legend: { orientation: "h", y: -0.2 } };
    base.xaxis = { ...base.xaxis, title: { text: "time in s" } };
    Plotly.react(this.curve, drawn.map(([name, [x, y]]) => ({ type: "scatter", mode: "lines", name, x, y })), base, { responsive: true, displayModeBar: false });
  }
}

async function drawMaps() {
  const element = /** @type {HTMLElement} */ (document.getElementById("maps"));
  Object.assign(window, { sweepPage: new SweepPage(await plotlyContent(), element) });
  element.dataset.ready = "";
}

drawMaps();
