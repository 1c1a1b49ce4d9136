/** The table of the present values. */

import { COLOURS, SMALLEST } from "./curves.js";
import { byId, element } from "./elements.js";
import { shortNames, unitsOf } from "./robot.js";

/** @typedef {import("./curves.js").Curves} Curves */
/** @typedef {import("./robot.js").Robot} Robot */

/** @type {(value: number) => string} A number as text, without a negative zero. */
function digits(value) {
  if (!Number.isFinite(value)) return "\u2013";
  const rounded = value.toFixed(Math.abs(value) < 10 ? 4 : 2);
  return rounded.replace(/^-(?=[0.]+$)/, "").replace("-", "\u2212");
}

export class Readout {
  /** @type {Map<string, HTMLElement>} cells of values other than joints, by name */
  more = new Map();

  /** @param {Robot} robot @param {Curves} curves */
  constructor(robot, curves) {
    this.robot = robot;
    const table = byId("readout"), { joints } = robot.facts;
    const names = shortNames(joints);
    table.append(element("tr", "", ...["", ...unitsOf(joints)].map((unit) => element("th", unit))));
    this.cells = joints.map((joint, i) => {
      const swatch = document.createElement("input");
      Object.assign(swatch, { type: "checkbox", checked: true, className: "swatch" });
      swatch.style.accentColor = COLOURS[i % COLOURS.length];
      swatch.setAttribute("aria-label", `curves of ${joint.name}`);
      swatch.addEventListener("change", () => curves.hidden[swatch.checked ? "delete" : "add"](i));
      const name = element("td", "", element("label", "", swatch, document.createTextNode(names[i])));
      name.title = joint.name;
      const cells = ["q", "v", "tau"].map(() => element("td", ""));
      cells[0].dataset.value = joint.name;
      table.append(element("tr", "", name, ...cells));
      return cells;
    });
  }

  /** @type {(name: string, text: string) => void} */
  describe(name, text) {
    let cell = this.more.get(name);
    if (!cell) {
      cell = element("td", "");
      Object.assign(cell, { colSpan: 3 }).dataset.value = name;
      this.more.set(name, cell);
      byId("readout").append(element("tr", "", element("td", name), cell));
    }
    cell.textContent = text;
  }

  /** @type {(k: number) => void} Show sample k. */
  show(k) {
    const { robot } = this, { session, facts } = robot, { joints } = facts, stopped = robot.stopped(k);
    joints.forEach((joint, i) => {
      ["q", "v", "tau"].forEach((group, c) => (this.cells[i][c].textContent = digits(session.value(group, k, i))));
      this.cells[i][0].className = stopped.includes(joint) ? "limit" : "";
    });
    const points = /** @type {[string, number[]][]} */ (facts.links.length > 1 ? [["end effector", robot.end(k)]] : []);
    if (points.length && session.groups.has("x_des")) points.push(["target", robot.target(k)]);
    for (const [name, point] of points) this.describe(name, `(${point.map(digits).join(", ")}) m`);
    const error = session.error(k), turn = robot.turnError(k), unit = session.groups.has("x_des") ? "m" : unitsOf(joints)[0];
    const errors = /** @type {[number, string][]} */ ([[error, unit], [turn, "rad"]]);
    const texts = errors.filter(([value]) => !Number.isNaN(value))
      .map(([value, of]) => `${Number((value < SMALLEST ? 0 : value).toPrecision(4))} ${of}`);
    if (session.follows) this.describe("error", texts.join(", ") || "\u2013");
    for (const [name, text] of session.remarks()) this.describe(name, text);
  }
}
