/** Curves over time, in panels with a common time axis: zoom, a common cursor, and lines that can be hidden. */

/** @typedef {import("./samples.js").Samples} Samples */

const MARGIN = { left: 58, right: 8, top: 20, bottom: 18 };
export const COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8c8c8c", "#9467bd"];
export const SMALLEST = 1e-12; // smaller values are rounding errors

export class Curves {
  /** @param {Samples} session @param {PanelFacts[]} panels @param {HTMLElement} parent */
  constructor(session, panels, parent) {
    this.session = session;
    /** @type {Set<number>} */
    this.hidden = new Set();
    /** @type {[number, number] | null} times chosen by the user; null: default */
    this.chosen = null;
    /** @type {number | null} */
    this.cursor = null;
    this.panels = panels.map((panel) => {
      const canvas = document.createElement("canvas");
      canvas.setAttribute("aria-label", panel.title);
      parent.append(canvas);
      this.listen(canvas);
      return { ...panel, canvas, drawn: "", rows: /** @type {Outline[]} */ ([]) };
    });
  }

  /** @returns {[number, number]} The interval of time that is shown, s. */
  get shown() {
    return this.chosen ?? this.session.span;
  }

  /** @param {HTMLCanvasElement} canvas */
  listen(canvas) {
    /** @param {MouseEvent} event */
    const time = (event) => {
      const [from, to] = this.shown, width = canvas.clientWidth - MARGIN.left - MARGIN.right;
      return from + ((event.offsetX - MARGIN.left) / width) * (to - from);
    };
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const [from, to] = this.shown, t = time(event), factor = Math.exp(event.deltaY / 500);
      if ((to - from) * factor > 2 * this.session.facts.step)
        this.chosen = [Math.max(0, t - (t - from) * factor), t + (to - t) * factor];
    }, { passive: false });
    canvas.addEventListener("pointermove", (event) => {
      const t = time(event);
      if (event.buttons & 1) {
        const [from, to] = this.shown;
        const moved = (-event.movementX / canvas.clientWidth) * (to - from);
        this.chosen = [Math.max(0, from + moved), Math.max(0, from + moved) + to - from];
      }
      this.cursor = t;
    });
    canvas.addEventListener("pointerleave", () => (this.cursor = null));
    canvas.addEventListener("dblclick", () => (this.chosen = null));
  }

  /** The sample at the cursor, or the one that is shown. */
  get sample() {
    return this.cursor === null ? this.session.now : this.session.nearest(this.cursor);
  }

  /** @param {string[]} inks of the theme: text, grid */
  draw(inks) {
    for (const panel of this.panels) this.drawPanel(panel, inks);
  }

  /** @type {(panel: Curves["panels"][number], inks: string[]) => void} */
  drawPanel(panel, [ink, hair]) {
    const { canvas } = panel, ratio = devicePixelRatio;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio))
      Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
    // asks the browser for software drawing, which takes a tenth of the time if graphics are emulated
    const settings = { willReadFrequently: true };
    const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", settings));
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const rows = this.rows(panel, width - MARGIN.left - MARGIN.right);
    const [low, high] = range(rows, panel.log);
    const [from, to] = this.shown;
    /** @param {number} t */
    const x = (t) => MARGIN.left + ((t - from) / (to - from)) * (width - MARGIN.left - MARGIN.right);
    /** @param {number} v */
    const y = (v) => height - MARGIN.bottom - ((v - low) / (high - low)) * (height - MARGIN.top - MARGIN.bottom);
    context.font = "11px system-ui, sans-serif";
    context.lineWidth = 1;
    axes(context, { width, height, x, y, low, high, from, to, log: panel.log, title: panel.title }, ink, hair);
    context.save();
    context.beginPath();
    context.rect(MARGIN.left, MARGIN.top, width - MARGIN.left - MARGIN.right, height - MARGIN.top - MARGIN.bottom);
    context.clip();
    for (const { line, points } of rows) {
      context.strokeStyle = COLOURS[line % COLOURS.length];
      context.setLineDash([5, 4]);
      for (const limit of panel.limits(line))
        if (limit !== null) stroke(context, [[x(from), y(limit)], [x(to), y(limit)]]);
      context.setLineDash([]);
      context.lineWidth = 1.5;
      stroke(context, points.map(([t, v]) => [x(t), y(v)]));
      context.lineWidth = 1;
    }
    if (this.cursor !== null || !this.session.steered) {
      context.strokeStyle = ink;
      const t = x(this.session.time(this.sample));
      stroke(context, [[t, 0], [t, height]]);
    }
    context.restore();
  }

  /** Points of the visible lines: for each pixel, the smallest and the largest of its samples. */
  /** @type {(panel: Curves["panels"][number], pixels: number) => Outline[]} */
  rows(panel, pixels) {
    const { session } = this, [from, to] = this.shown;
    const first = Math.max(0, session.nearest(from) - 1), last = Math.min(session.count - 1, session.nearest(to) + 1);
    const stride = Math.max(1, Math.ceil((last - first + 1) / Math.max(pixels, 50)));
    const drawn = [first, last, stride, session.time(last), ...this.hidden].join();
    if (drawn === panel.drawn) return panel.rows;
    panel.drawn = drawn;
    panel.rows = panel.lines.filter((line) => !this.hidden.has(line)).map((line) => {
      /** @type {number[][]} */
      const points = [];
      for (let k = first; k <= last; k += stride) {
        let least = k, largest = k;
        for (let i = k + 1; i < Math.min(k + stride, last + 1); i++) {
          if (panel.value(i, line) < panel.value(least, line)) least = i;
          if (panel.value(i, line) > panel.value(largest, line)) largest = i;
        }
        for (const i of new Set([Math.min(least, largest), Math.max(least, largest)])) {
          const value = panel.value(i, line);
          if (Number.isFinite(value))
            points.push([session.time(i), panel.log ? Math.log10(Math.max(value, SMALLEST)) : value]);
        }
      }
      return { line, points };
    });
    return panel.rows;
  }
}

/** @type {(rows: Outline[], log: boolean) => [number, number]} */
function range(rows, log) {
  let low = Infinity, high = -Infinity;
  for (const { points } of rows)
    for (const [, value] of points) [low, high] = [Math.min(low, value), Math.max(high, value)];
  if (!(low <= high)) return [0, 1];
  const room = Math.max((high - low) * 0.06, log ? 0.2 : Math.max(1e-3, 1e-6 * Math.abs(high)));
  return [low - room, high + room];
}

/** @type {(context: CanvasRenderingContext2D, points: number[][]) => void} */
function stroke(context, points) {
  context.beginPath();
  points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.stroke();
}

/** @type {(low: number, high: number, count: number) => number[]} About `count` round values between two limits. */
function ticks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5, 10].find((factor) => factor * power >= rough) ?? 10);
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.max(0, Math.floor(high / step + 1e-9) - first + 1) }, (_, i) => (first + i) * step);
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {{width: number, height: number, x: (t: number) => number, y: (v: number) => number, low: number, high: number, from: number, to: number, log: boolean, title: string}} frame
 * @param {string} ink
 * @param {string} hair
 */
function axes(context, frame, ink, hair) {
  const { width, height, x, y, low, high, from, to } = frame;
  context.fillStyle = ink;
  context.strokeStyle = hair;
  context.textAlign = "left";
  context.textBaseline = "top";
  context.fillText(frame.title, 4, 3);
  context.textAlign = "right";
  context.textBaseline = "middle";
  const marks = ticks(low, high, 4).filter((mark) => !frame.log || Number.isInteger(mark));
  for (const mark of marks) {
    stroke(context, [[MARGIN.left, y(mark)], [width - MARGIN.right, y(mark)]]);
    context.fillText(frame.log ? `10${superscript(mark)}` : short(mark), MARGIN.left - 5, y(mark));
  }
  context.textAlign = "center";
  context.textBaseline = "bottom";
  for (const mark of ticks(from, to, 5)) {
    stroke(context, [[x(mark), MARGIN.top], [x(mark), height - MARGIN.bottom]]);
    context.fillText(`${short(mark)} s`, Math.min(x(mark), width - 16), height - 2);
  }
}

/** @param {number} value */
function short(value) {
  return String(Number(value.toPrecision(6))).replace("-", "\u2212");
}

/** @param {number} value */
function superscript(value) {
  return String(value).replace("-", "⁻").replace(/\d/g, (digit) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[Number(digit)]);
}
