/** The page: what is stepped, drawn and told, and when. */

const TRAIL = 1.5; // s
const LATE = 0.25; // s behind the clock from which on time is let go
const BUSY = 0.012, SHARE = 0.5; // s of a frame, or its share, in which the plant is stepped
const CURVES = 0.1; // s between pictures of the curves, where no cursor asks for more

/**
 * @param {string} id
 * @returns {Promise<ArrayBuffer>}
 */
async function unpacked(id) {
  const bytes = Uint8Array.from(atob(byId(id).textContent), (c) => c.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
}

class App {
  /**
   * @param {Facts} facts
   * @param {Engine} engine
   * @param {ArrayBuffer} meshes
   */
  constructor(facts, engine, meshes) {
    this.session = new Session(facts, engine);
    this.robot = new Robot(facts);
    this.scene = new Scene(byId("scene"), facts, meshes);
    const links = this.robot.links(this.session.at("q"));
    this.reach = this.robot.reach(links) ?? { centre: [0, 0, 0], radius: 1 };
    this.camera = this.makeCamera(links);
    const tell = this.tell.bind(this);
    this.handle = new Handle(byId("scene"), this.camera, this.session, () => this.target(), tell);
    this.curves = new Curves(this.session, this.panels(), byId("curves"));
    this.readout = new Readout(this.session, this.curves);
    this.controls = new Controls(this.session, this.reach, tell);
    this.playing = true;
    this.due = 0; // time of the robot that the clock asks for, s
    this.drawn = -Infinity; // when the curves were, ms
    this.said = "";
    this.listen();
    this.before = performance.now();
    this.frame(this.before);
  }

  /** @param {Float64Array[]} links */
  makeCamera(links) {
    const { facts } = this.session, points = links.map((link) => transform(link, [0, 0, 0]));
    const flat = facts.axes.length === 2;
    const gravity = [1, 2, 3].map((i) => -Number(this.session.values.get(`gravity[${i}]`) ?? 0));
    const vertical = base(gravity.map(Math.abs).indexOf(Math.max(...gravity.map(Math.abs), 1e-9)));
    const up = Math.hypot(...gravity) ? vertical.map((n) => n * Math.sign(gravity[vertical.indexOf(1)])) : base(2);
    if (this.session.groups.has("x_des")) points.push(this.target());
    const { centre, radius } = this.reach;
    if (Number.isFinite(radius))
      for (const sign of [-0.5, 0.5])
        for (const i of flat ? ["x", "y", "z"].filter((c) => facts.axes.includes(c)).map((c) => "xyz".indexOf(c)) : [0, 1])
          points.push(plus(centre, sign * radius, base(i)));
    const across = base((up.findIndex(Boolean) + 1) % 3);
    let view = { front: plus(plus(across, -1, cross(up, across)), 0.55, up), vertical: up };
    if (flat) {
      const normal = base([0, 1, 2].find((i) => !facts.axes.includes("xyz"[i])) ?? 2);
      const inside = Math.abs(dot(normal, up)) < 0.5;
      const upright = inside ? up : base("xyz".indexOf(facts.axes[1]));
      const right = cross(upright, normal);
      view = { front: normal.map((n) => n * (right[0] + right[1] + right[2] > 0 ? 1 : -1)), vertical: upright };
    }
    return new Camera(view, flat, points);
  }

  /** Where the target is: on an axis that is not controlled, where the end effector is. */
  target() {
    const { session, robot } = this, place = transform(robot.frame(robot.links(session.at("q"))), [0, 0, 0]);
    session.facts.axes.split("").forEach((axis, i) => {
      place["xyz".indexOf(axis)] = Number(session.values.get(`x_des[${i + 1}]`) ?? place["xyz".indexOf(axis)]);
    });
    return place;
  }

  /**
   * Set a variable; a refusal is shown.
   * @param {string} name
   * @param {Value | number[]} value
   */
  tell(name, value) {
    this.attempt(() => this.session.set(name, value));
    if (this.session.variable((this.session.groups.get(name) ?? [name])[0]).causality === "parameter") this.due = 0;
  }

  /** @param {() => void} action */
  attempt(action) {
    try {
      action();
      this.said = "";
    } catch (refused) {
      this.said = refused instanceof Error ? refused.message : String(refused);
      this.play(false);
    }
  }

  /** @param {boolean} on */
  play(on) {
    this.playing = on;
    byId("play").textContent = on ? "Pause" : "Play";
    this.due = this.session.time(this.session.k);
  }

  panels() {
    const { session } = this, { facts } = session, all = facts.joints.map((_, i) => i);
    const units = unitsOf(facts.joints);
    const none = () => [];
    /** @type {Panel[]} */
    const panels = ["q", "v", "tau"].map((group, i) => ({
      title: `${["position", "velocity", "torque"][i]}, ${units[i]}`,
      value: (k, line) => session.at(group, k)[line],
      lines: all,
      log: false,
      limits: none,
    }));
    panels[0].limits = (line) => ["q_min", "q_max"].map((side) => Number(session.values.get(`${side}[${line + 1}]`)));
    panels[2].limits = (line) => [-(facts.joints[line].effort ?? NaN), facts.joints[line].effort ?? NaN];
    const unit = session.groups.has("x_des") ? "m" : units[0];
    if (!Number.isNaN(session.error()))
      panels.push({ title: `distance from the target, ${unit}`, value: (k) => session.error(k), lines: [0], log: true, limits: none });
    return panels;
  }

  listen() {
    /**
     * @param {string} id
     * @param {() => void} action
     */
    const on = (id, action) => byId(id).addEventListener("click", action);
    on("play", () => this.play(!this.playing));
    on("step", () => {
      this.play(false);
      this.attempt(() => this.session.step());
    });
    on("reset", () => this.restart(false));
    on("defaults", () => this.restart(true));
    on("home", () => this.camera.reset());
    on("download", () => this.download());
    addEventListener("keydown", (event) => {
      const outside = !document.body.matches(".whole") && !document.activeElement?.closest(".arm");
      const typing = event.target instanceof HTMLElement && event.target.matches("input, select, button, summary");
      if (outside || typing || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === " ") this.play(!this.playing);
      else if (event.key === "Home") this.camera.reset();
      else return;
      event.preventDefault();
    });
  }

  /** @param {boolean} all */
  restart(all) {
    this.attempt(() => this.session.startAgain(all));
    this.due = 0;
    this.curves.chosen = null;
  }

  download() {
    const link = document.createElement("a"), content = mcap(this.session, this.robot);
    link.href = URL.createObjectURL(new Blob([content]));
    link.download = `${this.session.facts.name}.mcap`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  }

  /** @param {number} now ms */
  frame(now) {
    const { session } = this, passed = (now - this.before) / 1000;
    this.before = now;
    if (this.playing) {
      this.due += passed * Number(byId("speed").value);
      const end = performance.now() + 1000 * Math.max(BUSY, SHARE * passed);
      this.attempt(() => {
        while (session.time(session.k + 1) <= this.due && performance.now() < end) session.step();
      });
      if (this.due - session.time(session.k) > LATE) this.due = session.time(session.k);
    }
    this.show();
    requestAnimationFrame((next) => this.frame(next));
  }

  show() {
    const { session, robot, scene, camera } = this, k = this.curves.sample, q = session.at("q", k);
    const links = robot.links(q), style = getComputedStyle(byId("scene").parentElement);
    const colour = (/** @type {string} */ name) => style.getPropertyValue(name).trim();
    this.addRobot(links);
    this.addTrail(k, links);
    camera.follow(transform(robot.frame(links), [0, 0, 0]));
    scene.draw(camera, fractions(colour("--scene")));
    if (this.curves.cursor !== null || this.before - this.drawn > 1000 * CURVES) {
      this.curves.draw([colour("--ink"), colour("--hair")]);
      this.drawn = this.before;
    }
    const stopped = robot.atLimit(q, session.values);
    this.readout.show(k, stopped);
    this.controls.show();
    byId("time").textContent = `${session.time(k).toFixed(2)} s`;
    const far = session.groups.has("x_des") && Math.hypot(...plus(this.target(), -1, this.reach.centre)) > this.reach.radius;
    const notes = [this.said, far ? "target out of reach" : "", ...stopped.map((joint) => `${joint.name} at limit`)];
    const text = notes.filter(Boolean).join("\n");
    if (byId("said").textContent !== text) byId("said").textContent = text;
  }

  /** @param {Float64Array[]} links */
  addRobot(links) {
    this.session.facts.shapes.forEach(({ link, place, colour }, i) => {
      this.scene.addSolid(i + 1, multiply(links[link], place), [...colour, 1]);
    });
  }

  /**
   * What is drawn beside the robot.
   * @param {number} k
   * @param {Float64Array[]} links
   */
  addTrail(k, links) {
    const { session, robot, scene, camera } = this, { facts } = session, size = camera.size;
    const first = Math.max(0, k - Math.round(TRAIL / facts.step)), stride = Math.max(1, Math.ceil((k - first) / 60));
    const trail = [];
    for (let i = first; i <= k; i += stride) trail.push(transform(robot.frame(robot.links(session.at("q", i))), [0, 0, 0]));
    scene.addLine([...trail, transform(robot.frame(links), [0, 0, 0])], [0, 0.447, 0.698, 1], 2);
    if (Number.isFinite(this.reach.radius)) {
      const planes = facts.axes.length === 2 ? [base([0, 1, 2].find((i) => !facts.axes.includes("xyz"[i])) ?? 2)] : [0, 1, 2].map(base);
      for (const normal of planes) scene.addLine(circle(this.reach.centre, this.reach.radius, normal), [0.5, 0.55, 0.6, 0.6], 0.6);
    }
    if (!session.groups.has("x_des")) return;
    scene.addSolid(0, placed(this.target(), 0.018 * size), [0.835, 0.369, 0, 0.8]);
    if (!this.handle.turns) return;
    const ends = [robot.frame(links), multiply(placed(this.target()), rotation(session.held("quat_des")))];
    AXIS_COLOURS.forEach((axisColour, axis) => {
      scene.addLine(this.handle.ring(axis), [...axisColour, 0.8], 1.2);
      for (const end of ends) {
        const from = transform(end, [0, 0, 0]);
        scene.addLine([from, plus(from, 0.09 * size, transform(end, base(axis), 0))], [...axisColour, 1], 1.8);
      }
    });
  }
}

/**
 * @param {number[]} centre
 * @param {number} radius
 * @param {number[]} normal
 */
function circle(centre, radius, normal) {
  const one = [normal[1], normal[2], normal[0]], two = cross(normal, one);
  return Array.from({ length: 97 }, (_, i) => {
    const angle = (2 * Math.PI * i) / 96;
    return plus(plus(centre, radius * Math.cos(angle), one), radius * Math.sin(angle), two);
  });
}

/** @param {string} colour as #rrggbb */
function fractions(colour) {
  return [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16) / 255);
}

async function main() {
  const facts = /** @type {Facts} */ (JSON.parse(byId("facts").textContent));
  const [module, meshes] = await Promise.all([unpacked("engine"), unpacked("meshes")]);
  const app = new App(facts, await Engine.load(new Uint8Array(module)), meshes);
  Object.assign(globalThis, { arm: app.session });
  byId("scene").dataset.ready = "";
}

main().catch((error) => {
  byId("said").textContent = error instanceof Error ? error.message : String(error);
});
