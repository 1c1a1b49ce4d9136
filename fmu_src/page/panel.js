/** The panel: curves, readout and sliders. */

import { Controls } from "./controls.js";
import { Curves } from "./curves.js";
import { byId, element, styled } from "./elements.js";
import { Readout } from "./readout.js";
import { unitsOf } from "./robot.js";
import { Verdict } from "./verdict.js";

/** @typedef {import("./robot.js").Robot} Robot */

export class Panel {
  /**
   * @param {Robot} robot
   * @param {{centre: number[], radius: number}} reach
   * @param {(name: string, value: Value | number[]) => void} tell
   */
  constructor(robot, reach, tell) {
    this.robot = robot;
    const { session } = robot;
    this.curves = new Curves(session, this.panels(), byId("curves"));
    this.readout = new Readout(robot, this.curves);
    this.controls = session.steered ? new Controls(session, reach, tell) : null;
    this.verdict = session.steered ? new Verdict(robot) : null;
    /** @type {string[]} */
    this.causes = [];
    byId("controls").append(...session.facts.remarks.map((remark) => element("p", remark)));
  }

  /** Definitions of the curves. */
  panels() {
    const { robot } = this, { session } = robot, { facts } = session, units = unitsOf(facts.joints);
    /** @type {Record<string, (line: number) => (number | null)[]>} */
    const limits = {
      q: (line) => ["q_min", "q_max"].map((side) => Number(session.values.get(`${side}[${line + 1}]`))),
      v: () => [],
      tau: (line) => [-(facts.joints[line].effort ?? NaN), facts.joints[line].effort ?? NaN],
    };
    /** @type {PanelFacts[]} */
    const panels = Object.keys(limits).map((group, i) => ({
      title: `${["position", "velocity", "torque"][i]}, ${units[i]}`,
      value: (k, line) => session.value(group, k, line),
      lines: session.at(group).length ? facts.joints.map((_, line) => line) : [],
      log: false,
      limits: limits[group],
    }));
    const unit = session.groups.has("x_des") ? "m" : units[0], title = `distance from the target, ${unit}`;
    if (session.follows) panels.push({ title, value: (k) => session.error(k), lines: [0], log: true, limits: limits.v });
    if (session.groups.has("quat_des"))
      panels.push({ title: "angle from the target orientation, rad", value: (k) => robot.turnError(k), lines: [0], log: true, limits: limits.v });
    return panels.filter(({ lines }) => lines.length);
  }

  /** @param {number} k */
  show(k) {
    const { robot } = this;
    this.curves.draw([styled("--ink"), styled("--hair")]);
    this.readout.show(k);
    this.causes = this.verdict?.lines() ?? [];
    this.controls?.show();
    byId("time").textContent = `${robot.session.time(k).toFixed(3)} s`;
  }
}
