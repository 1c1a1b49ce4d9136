/** The present verdict of a run: whether the target is reached and, if not, the causes, the root cause first. */

import { Balance } from "./balance.js";
import { MOTION, cause, forceUnit, short, speedUnit } from "./cause.js";
import { LASTING, MOVING, SMALL, byKinds, byParts, weight } from "./ranking.js";
import { GAINS, decay, loops, slowest, spectralRadius, swing } from "./sampled_loop.js";
import { Search } from "./search.js";

/** @typedef {import("./cause.js").Cause} Cause @typedef {import("./robot.js").Robot} Robot */

const BAND = 0.02, FLOOR = 1e-4, HELD = 1e-3; // part of the initial error, m or rad: reached; and if it is held and falls
const PATIENCE = 5, SETTLE = 1; // s: of a run that goes on, and after a change of the target for permanent causes only
const LOOKED_AT = 400, OFTEN = 0.05; // number of examined samples, and the share from which on a state is a cause
const SINGULAR = 0.02, POSES = 20; // ratio of the smallest to the largest singular value, and examined late poses
const STILL = 1e-3, CREEPING = 1e-5, FEWEST = 0.2; // part of the largest speed, and rad/s or m/s, at rest; damping ratio
const TAIL = 256, FAST = 0.25, FADING = 0.7; // examined last samples, reversals in a step that are too many, and decay of the speed
const SLIGHT = 1e-4, DRAG = 0.02, BALANCED = 9; // loads, and efforts of damping of a joint, relative to the largest effort; samples of the balance
const UNSTABLE = 1 + 1e-4, SPOILT = 0.5; // spectral radius, and rate of decay relative to that of a continuous controller

export class Verdict {
  began = 0; // sample at which the target was changed
  target = "";
  way = [0, 0]; // errors of position or joints (m or rad) and orientation (rad) at that time

  /** @param {Robot} robot */
  constructor(robot) {
    this.session = robot.session;
    this.robot = robot;
    this.joints = robot.facts.joints;
    this.search = new Search(robot);
    this.balance = new Balance(robot, this.search);
  }

  /** @returns {string[]} Lines of the verdict at the latest sample. */
  lines() {
    const [root, ...others] = this.causes();
    if (!root) return [];
    if (!this.session.follows) return [root, ...others].map(({ text }) => text);
    if (!this.missed().includes(true)) return [`reached; but ${root.text}`];
    const all = this.grouped([root, ...others]), rest = root.noted ? all : all.slice(1), runaway = root.kind === "unstable";
    /** @type {(noted: boolean, word: string) => string[]} */
    const named = (noted, word) => rest.filter((other) => other.noted === noted).map(({ text }) => `${word} ${text}`);
    const lines = [root.noted ? "not reached" : `not reached: ${all[0].text}`, ...named(false, "also"), ...(runaway ? [] : named(true, "note:"))];
    const moved = this.began || this.picked().some((k) => this.session.at("v", k).some(Boolean));
    return [...lines.slice(0, 3), ...(moved ? [] : ["no joint ever moved"])];
  }

  /** The worst cause of each kind with the joints of its others, and all causes without a joint. */
  /** @type {(causes: Cause[]) => Cause[]} */
  grouped(causes) {
    return causes.flatMap((each) => {
      const same = causes.filter(({ kind, noted, joint, share }) => // a joint that creeps has the share 0
        joint >= 0 && kind === each.kind && noted === each.noted && share > 0 === each.share > 0);
      if (each.joint < 0) return [each];
      const names = same.length === this.joints.length && same.length > 2 ? "all other joints"
        : same.slice(1).map(({ joint }) => `'${this.joints[joint].name}'`).join(", ");
      const text = each.text.replace(/;|$/, (end) => (names && `, likewise ${names}`) + end);
      return each === same[0] ? [{ ...each, text }] : [];
    });
  }

  /** @returns {Cause[]} Causes at the latest sample, the root first. */
  causes() {
    const { session } = this, last = session.count - 1;
    if (!session.follows) return this.atLimits();
    const target = ["x_des", "quat_des", "q_des"].map((group) => session.held(group).join()).join(";");
    if (target !== this.target || last < this.began) {
      this.target = target;
      this.began = last < this.began ? 0 : last;
      this.way = this.errors(last);
    }
    const missed = this.missed(), found = [...this.degrees(), ...this.beyond()];
    const waited = session.time(last) - session.time(this.began) >= SETTLE;
    if (missed.includes(true)) found.push(...this.reach(missed[0], waited), ...this.gains(missed), ...this.atLimits());
    const parts = missed.includes(true) && waited ? this.balance.parts(this.late(), missed) : new Map();
    if (missed.includes(true) && waited) {
      found.push(...this.loads(), ...this.friction(parts), ...this.saturated(), ...this.feedforward(missed), ...this.sampled());
      found.push(...this.damping(missed), ...this.singular(), ...this.slow(missed));
      const restless = Math.max(weight("time", "", parts), Math.abs(parts.get("sampling ") ?? 0));
      if (restless > LASTING && !found.some(({ kind }) => MOVING.includes(kind))) found.push(...this.unsettled());
    }
    return this.ranked(found, missed, parts);
  }

  /** Causes by their parts in the error, which the balance of forces gives after some time. */
  /** @type {(found: Cause[], missed: boolean[], parts: Map<string, number>) => Cause[]} */
  ranked(found, missed, parts) {
    const order = this.robot.facts.causes, far = Math.max(0, ...found.filter(({ kind }) => kind === "reach").map(({ share }) => share));
    const size = Math.sqrt(this.late().reduce((sum, k) => sum + this.errors(k)[0] ** 2, 0) / this.late().length);
    const last = this.session.count - 1, passed = this.session.time(last) - this.session.time(this.began);
    const reach = far / Math.max(size, FLOOR), now = this.errors(last), grown = missed.every((off, i) => !off || now[i] > this.way[i]);
    const ranked = parts.size ? byParts(found, parts, order, { reach, passed, grown }) : byKinds(found, order);
    if (ranked.length) ranked[0].noted = MOTION.includes(ranked[0].kind) && missed.includes(true); // a peak makes no error
    return ranked;
  }

  /** Some samples of the last quarter of the time since the last change of the target. */
  late() {
    const late = this.picked(0.25), stride = Math.ceil(late.length / BALANCED);
    return late.filter((_, i) => (late.length - 1 - i) % stride === 0);
  }

  /** @type {(k: number) => number[]} Errors in sample k of position or joints, and of orientation; 0 without a target. */
  errors(k) {
    return [this.session.error(k), this.session.groups.has("quat_des") ? this.robot.turnError(k) : 0];
  }

  /** Whether position or joints, and orientation, are not at their targets in the last tenth of the time. */
  missed() {
    const late = this.picked(0.1).map((k) => this.errors(k));
    return this.way.map((way, i) => {
      const falls = way <= FLOOR && late.every((errors, k) => !k || errors[i] <= late[k - 1][i]);
      return !(Math.max(...late.map((errors) => errors[i])) <= Math.max(BAND * way, falls ? HELD : FLOOR));
    });
  }

  /** Numbers of evenly spaced samples since the last change of the target, or of the last `part` of that time. */
  picked(part = 1) {
    const last = this.session.count - 1, count = Math.floor(part * (last - this.began)), found = [];
    const stride = Math.max(1, Math.ceil(count / LOOKED_AT));
    for (let k = last; k >= last - count; k -= stride) found.unshift(k);
    return found;
  }

  /** Shares of these samples, and of their last quarter, with a condition. */
  /** @type {(so: (k: number) => boolean) => number[]} */
  shares(so) {
    return [1, 0.25].map((part) => this.picked(part)).map((each) => each.filter(so).length / each.length);
  }

  degrees() {
    const { session, joints } = this;
    return ["q_des", "q_start"].flatMap((group) => session.held(group).flatMap((value, i) => {
      const { prismatic } = joints[i], [low, high] = this.search.limits(i), meant = (value * Math.PI) / 180;
      const fits = meant >= low && meant <= high;
      const way = group === "q_start" ? value : value - session.value("q", 0, i); // that of a continuous joint may be short
      const is = `${group}[${i + 1}] is ${short(value)} rad`, text = `${is}; did you mean ${short(value)}°, which is ${String(Number(meant.toPrecision(5))).replace("-", "\u2212")} rad?`;
      return !prismatic && Math.min(Math.abs(value), Math.abs(way)) > 2 * Math.PI && fits ? [cause("degrees", text)] : [];
    }));
  }

  /** @type {(missed: boolean, waited: boolean) => Cause[]} */
  reach(missed, waited) {
    const { session, joints, robot } = this, wanted = session.held("x_des");
    const outside = session.held("q_des").flatMap((value, i) => {
      const [low, high] = this.search.limits(i), { name, prismatic } = joints[i], unit = prismatic ? "m" : "rad";
      const by = Math.max(low - value, value - high);
      const text = `the target ${short(value)} ${unit} of joint '${name}' is out of reach by ${short(by)} ${unit}${!prismatic && Math.abs(value) > 2 * Math.PI ? "; is it in degrees?" : ""}`;
      return by > 1e-9 && !this.degrees().length ? [cause("reach", text, by)] : [];
    });
    if (!wanted.length || !missed) return outside;
    const ball = robot.reach() ?? { centre: [0, 0, 0], radius: Infinity };
    const far = Math.hypot(...wanted.map((value, i) => value - ball.centre[session.axes[i]])) > ball.radius;
    if (!far && !waited) return outside;
    const { point, distance } = this.search.nearest(wanted);
    if (distance <= Math.max(BAND * this.way[0], FLOOR)) return outside;
    const millimetres = Math.max(...wanted.map(Math.abs)) > 10 ? "; is the target in millimetres?" : "";
    const text = `target out of reach by ${short(distance)} m; the nearest reachable point is (${point.map(short).join(", ")}) m${millimetres}`;
    return [cause("reach", text, distance)];
  }

  /** The name of element i of a gain, and its direction or joint, unless all elements are equal. */
  /** @type {(group: string, i: number) => string} */
  gain(group, i) {
    const { session, joints } = this, values = session.held(group);
    if (values.length > 1 && Math.max(...values) === Math.min(...values)) return group;
    if (group.endsWith("_rot")) return `${group}[${i + 1}] (about ${"xyz"[i]})`;
    const where = session.groups.has("x_des") ? `along ${"xyz"[session.axes[i]]}` : `of joint '${joints[i].name}'`;
    return `${group}[${i + 1}] (${where})`;
  }

  /** @type {(k: number, i: number) => boolean} Whether element i of the error counts; an orientation's has none. */
  isOff(k, i) {
    const { session } = this, [now, wanted] = session.follows ?? ["", ""], q = session.at(now, session.count - 1);
    const error = k ? [] : session.held(wanted).map((value, n) => Math.abs(value - q[n]));
    return !(error[i] < 0.1 * Math.max(...error));
  }

  /** @type {(missed: boolean[]) => Cause[]} */
  gains(missed) {
    const zero = GAINS.flatMap(([stiff], k) =>
      missed[k] ? this.session.held(stiff).flatMap((gain, i) => (gain === 0 && this.isOff(k, i) ? [this.gain(stiff, i)] : [])) : []);
    const text = `${[...new Set(zero)].join(", ")} = 0: the controller does not reduce this error; raise the gain`;
    return zero.length ? [cause("gain", text)] : [];
  }

  /** @type {(missed: boolean[]) => Cause[]} */
  feedforward(missed) {
    const rates = [["xd_des", "xdd_des", "v_des", "a_des"], ["omega_des", "alpha_des"]];
    return rates.flatMap((groups, k) => (missed[k] ? groups : [])).filter((group) => this.session.held(group).some(Boolean)).map((group) =>
      cause("feedforward", `${group} = (${this.session.held(group).map(short).join(", ")}) is not 0, while the target rests; set it to 0`, 0, -1, group));
  }

  atLimits() {
    const { session, robot } = this, q = session.at("q"), wanted = session.held("q_des"), inSpace = session.groups.has("x_des");
    return this.robot.stopped(session.now).flatMap((joint) => {
      const i = this.joints.indexOf(joint), [low, high] = this.search.limits(i), side = 2 * q[i] < low + high ? "lower" : "upper";
      const limit = side === "lower" ? low : high, [share] = this.shares((k) => session.value("q", k, i) === limit);
      const idle = inSpace ? !robot.movers().includes(i) : wanted[i] === limit;
      return idle ? [] : [cause("limit", `joint '${joint.name}' is at its ${side} limit`, share, i)];
    });
  }

  /** Joints that stick, or whose friction has a part in the error. */
  /** @type {(parts: Map<string, number>) => Cause[]} */
  friction(parts) {
    const { session } = this;
    return session.held("friction").flatMap((size, i) => {
      const [still, late] = this.shares((k) => Math.abs(session.value("v", k, i)) < CREEPING), sticks = late > 0.9;
      const counts = parts.size ? Math.abs(parts.get(`friction ${i}`) ?? 0) >= SMALL : sticks;
      const text = `joint '${this.joints[i].name}' ${sticks ? "sticks" : "creeps"}: its friction of ${short(size)} ${forceUnit(this.joints[i])} ${sticks ? "holds it" : "slows it down"}`;
      return size > 0 && counts ? [cause("friction", text, sticks ? still : 0, i)] : [];
    });
  }

  saturated() {
    const { session, joints } = this;
    return session.values.get("limit_effort") !== true ? [] : joints.flatMap(({ name, effort }, i) => {
      const shares = effort === null ? [0, 0] : this.shares((k) => Math.abs(session.value("tau", k, i)) >= effort * (1 - 1e-9));
      const text = `the motor of joint '${name}' is saturated for ${Math.round(100 * shares[0])} % of the time`;
      return shares[0] > OFTEN && shares[1] > OFTEN ? [cause("saturation", text, shares[0], i)] : [];
    });
  }

  /** Efforts and speeds beyond the URDF's limits. */
  beyond() {
    return ["effort", "velocity"].flatMap((kind, side) => this.joints.flatMap((joint, i) => {
      const limit = [joint.effort, joint.velocity][side] ?? Infinity, group = ["tau", "v"][side];
      const peak = Math.max(...this.picked().map((k) => Math.abs(this.session.value(group, k, i))));
      const text = `joint '${joint.name}' needs ${["an effort", "a speed"][side]} beyond the URDF's limit of ${short(limit)} ${side ? speedUnit(joint) : forceUnit(joint)}`;
      return peak > limit * (1 + 1e-9) ? [cause(kind, text, peak / limit, i)] : [];
    }));
  }

  /** Loads and the damping of joints, which the controller does not know. */
  loads() {
    const { session } = this, { values } = session, found = [], unknown = "the controller does not know the";
    const payload = Number(values.get("payload") ?? 0), most = Math.max(...this.picked().flatMap((k) => [...session.at("tau", k)].map(Math.abs)), 1e-300);
    if (payload * 9.81 > SLIGHT * most && values.get("payload_known") !== true)
      found.push(cause("load", `${unknown} payload of ${short(payload)} kg`, (payload * 9.81) / most, -1, "payload"));
    for (const group of ["tau_ext", "f_ext"])
      if (session.held(group).some((value) => Math.abs(value) > SLIGHT * most))
        found.push(cause("load", `the controller does not know ${this.external(group)}`, Math.max(...session.held(group).map(Math.abs)) / most, -1, group));
    /** @type {(own: (damping: number, i: number) => boolean) => string[]} */
    const damped = (own) => session.held("damping").flatMap((size, i) => (own(size, i) ? [`'${this.joints[i].name}'`] : []));
    const heavy = damped((size, i) => size > 2 * this.joints[i].damping), some = damped((size) => size > 0);
    if (heavy.length) found.push(cause("load", `${unknown} damping of joints ${heavy.join(", ")}`, 1, -1, "damping"));
    else if (some.length && this.drags()) found.push(cause("drag", `${unknown} damping of joints ${some.join(", ")} in the URDF`));
    return found;
  }

  /** @type {(group: string) => string} A force, or the largest three torques with their joints. */
  external(group) {
    const values = this.session.held(group), own = [...values.keys()].filter((i) => values[i]).sort((i, j) => Math.abs(values[j]) - Math.abs(values[i]));
    if (group === "f_ext") return `${group} = (${values.map(short).join(", ")}) N`;
    return own.slice(0, 3).map((i) => `${group}[${i + 1}] (of joint '${this.joints[i].name}') = ${short(values[i])} ${forceUnit(this.joints[i])}`).join(", ") + (own.length > 3 ? ` and ${own.length - 3} more` : "");
  }

  /** Whether damping needs a part of the late effort of a joint with an error. */
  drags() {
    const { session } = this, late = this.picked(0.25), targets = session.held("q_des");
    /** @type {(group: string, i: number) => number} */
    const most = (group, i) => Math.max(...late.map((k) => Math.abs(session.value(group, k, i))));
    const off = this.joints.map((_, i) => (targets.length ? Math.abs(targets[i] - session.value("q", session.count - 1, i)) : 1));
    const counts = 0.1 * Math.max(...off);
    return session.held("damping").some((size, i) => off[i] >= counts && size * most("v", i) > DRAG * most("tau", i));
  }

  /** Gains of an unstable loop, or else a joint that reverses as fast as the controller's steps. */
  sampled() {
    const { session, joints } = this, last = session.count - 1, first = Math.max(0, last + 1 - TAIL);
    const [period, delay] = ["control_period", "control_delay"].map((name) => Number(session.values.get(name) ?? 0));
    if (!period || last - first < 15) return [];
    /** @type {(i?: number) => string} Settings of the controller and of a joint's sensors. */
    const settings = (i) => ["control_period", "control_delay", ...["q_resolution", "q_noise", "v_noise"].map((each) => `${each}[${i}]`)].flatMap((name) => {
      const value = Number(session.values.get(name) ?? 0);
      return value ? [`${name} = ${short(value)} ${this.session.variable(name).unit}`] : [];
    }).join(", ");
    const differences = session.values.get("v_from_q") === true;
    const loaded = Number(session.values.get("payload") ?? 0) !== 0; // a load lowers the true gains
    /** @type {(part: number) => number} */
    const speed = (part) => Math.max(...this.picked(part).flatMap((k) => [...session.at("v", k)].map(Math.abs)));
    const rests = !this.robot.stopped(session.now).length && speed(0.25) <= STILL * Math.max(speed(1), FLOOR);
    const late = this.picked(0.2).map((k) => this.errors(k));
    const falls = [0, 1].map((i) => late.every((errors, k) => !k || errors[i] < late[k - 1][i]));
    const unstable = loops(session, joints.length).flatMap(([stiff, damp, Kp, Kd], k) => {
      const radii = Kp.map((p, i) => spectralRadius(p, Kd[i], period, delay, differences)), radius = Math.max(...radii);
      const i = radii.indexOf(radius), rate = -Math.log(radius) / period, gains = [stiff && this.gain(stiff, i), this.gain(damp, i)].filter(Boolean);
      if (stiff && Kd[i] < FEWEST * 2 * Math.sqrt(Kp[i]) && -Math.log(BAND) / decay(Kp[i], Kd[i]) > 2 * PATIENCE) return []; // it lacks damping
      const slow = stiff && rate < SPOILT * decay(Kp[i], Kd[i]) && -Math.log(BAND) > PATIENCE * rate;
      const text = `${gains.join(" and ")} ${stiff ? "are" : "is"} too high for ${settings()}: the loop${stiff ? "" : " of the self-motion"} is`;
      if ((loaded && (rests || falls[k])) || !(radius > UNSTABLE || slow)) return [];
      return [cause("unstable", `${text} ${radius > UNSTABLE ? "unstable" : "close to unstable"}`, -rate)];
    });
    if (unstable.length) return unstable;
    const turns = joints.map((_, i) => {
      const v = Array.from({ length: last + 1 - first }, (__, k) => session.value("v", first + k, i));
      const peak = Math.max(...this.picked().map((k) => Math.abs(session.value("v", k, i))), 1e-3);
      const mean = (/** @type {number[]} */ part) => part.reduce((sum, value) => sum + Math.abs(value), 0) / part.length, half = v.length >> 1;
      return mean(v) > 1e-3 * peak && mean(v.slice(half)) > FADING * mean(v.slice(0, half)) ? v.filter((value, k) => k && value * v[k - 1] < 0).length / (v.length - 1) : 0;
    });
    const most = Math.max(...turns), joint = turns.indexOf(most), step = this.robot.facts.step;
    const often = `joint '${joints[joint].name}' reverses every ${short(step / most)} s`;
    if (most * Math.max(step, period + delay) < FAST * step) return [];
    return [cause("sampling", `${often}: the gains are too high for ${settings(joint + 1)}`)];
  }

  /** @type {(missed: boolean[]) => Cause[]} */
  damping(missed) {
    const { session } = this;
    return GAINS.flatMap(([stiff, damp], k) => {
      const Kd = session.held(damp), Kp = session.held(stiff), i = Kp.findIndex((p, n) => p > 0 && Kd[n] < FEWEST * 2 * Math.sqrt(p));
      if (!missed[k] || i < 0) return [];
      return [cause("damping", `${this.gain(damp, i)} = ${short(Kd[i])} s⁻¹ damps too little: critical is ${short(2 * Math.sqrt(Kp[i]))} s⁻¹`)];
    });
  }

  /** A pose near a singularity late in the run, unless the joints that move the end effector cannot avoid it. */
  singular() {
    const { session, robot } = this, axes = [...session.axes, ...(session.groups.has("quat_des") ? [3, 4, 5] : [])];
    if (!session.groups.has("x_des") || axes.length > robot.movers().length) return [];
    const near = this.picked(0.25).filter((_, k, all) => k % Math.ceil(all.length / POSES) === 0).some((k) => this.search.ratio([...session.at("q", k)], axes) < SINGULAR);
    return near ? [cause("singularity", "the arm is near a singularity")] : [];
  }

  /** The reason of an error that moves, and neither decays steadily nor lacks damping. */
  unsettled() {
    const { session } = this, rates = [0, 1].map((i) => slowest(session, i)), last = session.count - 1;
    const left = -Math.log(BAND) / Math.min(...rates) - (session.time(last) - session.time(this.began));
    const settings = ["control_period", "control_delay"].filter((name) => Number(session.values.get(name) ?? 0) > 0);
    if (left > PATIENCE) return [cause("time", `with these gains the error is within 2 % after about ${short(left)} s more`, left)];
    const coarse = this.joints.flatMap((_, i) => ["q_resolution", "q_noise", "v_noise"].map((name) => `${name}[${i + 1}]`)).filter((name) => Number(session.values.get(name) ?? 0) > 0);
    if (coarse.length) return [cause("sampling", `the controller measures with ${coarse[0]} = ${short(Number(session.values.get(coarse[0])))}: it does not see smaller errors`)];
    return left <= 0 && settings.length ? [cause("sampling", `the motion does not settle: ${settings.join(" and ")} make the efforts too late`)] : [];
  }

  /** Errors that still shrink, with the remaining time by their rate. */
  /** @type {(missed: boolean[]) => Cause[]} */
  slow(missed) {
    const { session } = this, late = this.picked(0.2), end = late.length - 1, passed = session.time(late[end]) - session.time(late[0]);
    const over = session.held("Kp").some((p, i) => session.held("Kd")[i] > 2 * Math.sqrt(p)), most = [0, 1].map((i) => swing(session, i));
    return missed.flatMap((is, i) => {
      const size = late.map((k) => this.errors(k)[i]), rate = Math.min(Math.log(size[0] / size[end]) / passed, most[i]);
      const left = Math.log(Math.max(size[end] / Math.max(BAND * this.way[i], FLOOR), 1)) / rate;
      const falls = is && end > 1 && size[end] > 0 && rate * passed > 1e-6 && size.every((value, k) => !k || value < size[k - 1]);
      const what = i ? "orientation still approaches its target" : session.groups.has("q_des") ? "joints still approach their targets" : "position still approaches its target";
      return falls && left > PATIENCE && left < 5000 * passed ? [cause("time", `the ${what}: within 2 % after about ${short(left)} s more, or ${over ? "raise Kp" : "raise the gains"}`, left)] : [];
    });
  }
}
