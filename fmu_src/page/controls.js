/** Sliders for the FMU's inputs and parameters. */

import { byId, element } from "./elements.js";
import { shortNames } from "./robot.js";

/** @typedef {import("./samples.js").Samples} Samples */

const GAINS = ["Kp", "Kd", "Kp_rot", "Kd_rot", "Kn"];
const JOINTS = ["friction", "damping", "armature"];
const SENSORS = ["q_resolution", "q_noise", "v_noise"];
const PER_JOINT = ["q_des", "v_des", "a_des", "tau_cmd", "tau_ext", "q_start", "v_start", ...JOINTS, ...SENSORS];
const LAW = ["Kp", "Kd"]; // per axis, or per joint in joint-space control
const PER_AXIS = ["x_des", "xd_des", "xdd_des", ...LAW];
const GROUPS = /** @type {[string, boolean, string[]][]} */ ([
  ["target or command", true, ["x_des", "quat_des", "q_des", "tau_cmd"]],
  ["gains", true, GAINS],
  ["disturbance and payload", false, ["f_ext", "tau_ext", "payload", "payload_com", "payload_known"]],
  ["feedforward", false, ["xd_des", "xdd_des", "omega_des", "alpha_des", "v_des", "a_des"]],
  ["parameters (a change restarts the simulation)", false, ["limit_effort", "rigid_stops", "q_start", "v_start", "gravity"]],
  ["joints (a change restarts the simulation)", false, JOINTS],
  ["sampling (a change restarts the simulation)", false, ["control_period", "control_delay", "v_from_q", ...SENSORS]],
]);

export class Controls {
  /**
   * @param {Samples} session
   * @param {{centre: number[], radius: number}} reach
   * @param {(name: string, value: Value | number[]) => void} onChange
   */
  constructor(session, reach, onChange) {
    this.session = session;
    this.reach = reach;
    this.onChange = onChange;
    this.names = shortNames(session.facts.joints);
    /** @type {{names: string[], inputs: HTMLInputElement[]}[]} variables and the inputs that set all of them */
    this.fields = [];
    /** @type {{names: string[], button: HTMLButtonElement, open: (on: boolean) => void}[]} gains with sliders on demand */
    this.gains = [];
    for (const [title, open, groups] of GROUPS) {
      const rows = groups.filter((group) => session.groups.has(group)).flatMap((group) => this.rows(group));
      if (!rows.length) continue;
      const details = element("details", "", element("summary", title), ...rows);
      details.toggleAttribute("open", open);
      byId("controls").append(details);
    }
  }

  /** @type {(group: string) => HTMLElement[]} The sliders of a group, one for each element. */
  rows(group) {
    const names = /** @type {string[]} */ (this.session.groups.get(group));
    const rows = names.map((name) => this.row(name, [name]));
    if (GAINS.includes(group) && names.length > 1) return [this.common(group, names, rows), ...rows];
    return PER_JOINT.includes(group) ? [element("div", group), ...rows] : rows;
  }

  /** A slider for all elements of a vector, with a button that shows their own. */
  /** @type {(group: string, names: string[], rows: HTMLElement[]) => HTMLElement} */
  common(group, names, rows) {
    const button = document.createElement("button"), row = this.row(group, names);
    const open = (/** @type {boolean} */ on) => {
      button.textContent = on ? "▾" : "▸";
      button.setAttribute("aria-expanded", String(on));
      for (const own of rows) own.hidden = !on;
    };
    Object.assign(button, { type: "button", title: "a slider for each element" });
    button.setAttribute("aria-label", `each element of ${group}`);
    button.addEventListener("click", () => open(rows[0].hidden));
    /** @type {HTMLElement} */ (row.firstChild).append(" ", button);
    open(false);
    this.gains.push({ names, button, open });
    return row;
  }

  /** @type {(name: string, names: string[]) => HTMLElement} Row of a variable, or of a vector's elements together. */
  row(name, names) {
    const { session } = this, [first] = names, variable = session.variable(first);
    const value = session.values.get(first);
    const label = element("span", this.label(name)), [low, high] = this.range(name, Number(value));
    label.title = `${name}: ${variable.description}${variable.unit ? `, ${variable.unit}` : ""}`;
    const inputs = (typeof value === "boolean" ? ["checkbox"] : ["range", "number"]).map((type) => {
      const input = document.createElement("input"), typed = type === "range" ? "slider" : variable.unit || "number";
      Object.assign(input, { type, step: "any", checked: value === true });
      if (type === "range") Object.assign(input, { min: String(low), max: String(high) });
      if (type !== "checkbox") input.value = String(value);
      if (type !== "checkbox") input.setAttribute("aria-label", `${name}, ${typed}`);
      input.addEventListener(variable.causality === "parameter" || type !== "range" ? "change" : "input", () => {
        if (type === "checkbox") this.onChange(name, input.checked);
        else if (input.value !== "") this.onChange(name, Number(input.value));
      });
      return input;
    });
    this.fields.push({ names, inputs });
    const row = element("label", "", label, ...inputs, element("small", unitText(variable.unit)));
    row.className = "slider";
    return row;
  }

  /** @type {(name: string) => string} A variable's name, with that of its joint or axis in place of its number. */
  label(name) {
    const [group, number] = name.replace("]", "").split("["), { axes } = this.session.facts;
    if (number === undefined) return name;
    const i = Number(number) - 1;
    if (PER_JOINT.includes(group) || (LAW.includes(group) && this.session.groups.has("q_des"))) return this.names[i];
    return `${group} ${(PER_AXIS.includes(group) ? axes : "xyzw")[i]}`;
  }

  /** @type {(name: string, value: number) => [number, number]} The range of a slider. */
  range(name, value) {
    const [group, number] = name.replace("]", "").split("["), i = Number(number) - 1;
    const { reach, session } = this, { joints } = session.facts, joint = joints[i];
    const strongest = Math.max(...joints.map(({ effort }) => effort ?? 0)) || 20;
    const force = strongest / (reach.radius || 1);
    if (GAINS.includes(group)) return [0, Math.max(4 * value, 20)];
    if (group === "x_des") {
      const middle = reach.centre[session.axes[i]];
      return [middle - 1.1 * reach.radius, middle + 1.1 * reach.radius];
    }
    if (group === "q_des" || group === "q_start") return [joint.low ?? -Math.PI, joint.high ?? Math.PI];
    if (group === "tau_cmd" || group === "tau_ext") return [-(joint.effort ?? strongest), joint.effort ?? strongest];
    if (group === "payload") return [0, force / 9.81];
    if (JOINTS.includes(group)) return [0, Math.max(4 * value, group === "armature" ? 1 : 0.2 * (joint.effort ?? strongest))];
    const sampled = { control_period: 0.05, control_delay: 0.05, q_resolution: 0.01, q_noise: 0.01, v_noise: 0.1 }[group];
    if (sampled) return [0, Math.max(4 * value, sampled)];
    const most = { f_ext: force, payload_com: 0.3, gravity: 20, quat_des: 1 }[group] ?? 5;
    return [-most, most];
  }

  /** Show the session's values, except in a field in which the user types. */
  show() {
    const { values } = this.session;
    /** @param {string[]} names */
    const alike = (names) => names.every((name) => values.get(name) === values.get(names[0]));
    for (const { names, button, open } of this.gains) {
      button.disabled = !alike(names); // gains that differ stay visible
      if (button.disabled) open(true);
    }
    for (const { names, inputs } of this.fields) {
      const value = values.get(names[0]);
      for (const input of inputs) {
        if (input.type === "checkbox") input.checked = Boolean(value);
        else if (document.activeElement !== input || input.type === "range") {
          const typed = alike(names) ? String(Number(Number(value).toFixed(6))) : "";
          const text = input.type === "range" ? String(value) : typed;
          if (input.value !== text) input.value = text;
        }
      }
    }
  }
}

/** @type {(unit: string) => string} An FMI unit in common spelling: 1/s2 is s⁻². */
function unitText(unit) {
  return unit.replace("1/s2", "s⁻²").replace("1/s", "s⁻¹").replace("2", "²").replace(/\./g, "·");
}
