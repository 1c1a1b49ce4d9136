/** The page: steps the session, draws it and handles its controls. */

const TRAIL = 1.5; // s
const TILES = 10; // of the floor, to each side
const MOMENTS = 30, PATH_POINTS = 600; // of a replay, that are in the picture at first, and of its path
const PANEL = 0.1; // s between pictures of curves and numbers, where no cursor asks for more

/** @type {(id: string) => Promise<ArrayBuffer>} */
async function unpacked(id) {
  const text = atob(byId(id).textContent), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
}

const SLOW = 0.04, SLOW_FRAMES = 10; // s of a frame, and so many in a row, from which on edges are not smoothed

class App {
  /**
   * @param {Facts} facts
   * @param {Session | Replay | Remote} session
   * @param {ArrayBuffer} meshes
   */
  constructor(facts, session, meshes) {
    this.session = session;
    if (session instanceof Session) {
      const restore = () => this.attempt(() => session.restore(location.hash.slice(1)));
      if (location.hash) restore();
      addEventListener("hashchange", restore);
    }
    for (const id of session.without) byId(id).hidden = true;
    this.robot = new Robot(facts);
    const gl = byId("scene").getContext("webgl2", { antialias: false, alpha: false });
    this.scene = gl && new Scene(byId("scene"), gl, facts, meshes);
    const links = this.robot.links(session.at("q"));
    this.path = session.steered ? [] : spread(session.count, PATH_POINTS).map((k) => this.end(k));
    this.reach = this.robot.reach(links) ?? { centre: [0, 0, 0], radius: 1 };
    this.camera = this.makeCamera();
    const tell = this.tell.bind(this);
    this.handle = new Handle(byId("scene"), this.camera, this.session, () => this.target(), tell);
    this.curves = new Curves(this.session, this.panels(), byId("curves"));
    this.readout = new Readout(this.session, this.curves);
    this.controls = session.steered ? new Controls(session, this.reach, tell) : null;
    this.verdict = session.steered ? new Verdict(session, this.robot) : null;
    /** @type {string[]} */
    this.lines = [];
    byId("controls").append(...facts.remarks.map((remark) => element("p", remark)));
    this.drawn = -Infinity; // when the panel was, ms
    this.slow = 0; // frames, until now
    this.listen();
    this.before = performance.now();
    this.frame(this.before);
  }

  makeCamera() {
    const { session, robot } = this, { facts } = session, points = [...this.path];
    for (const k of session.steered ? [session.now] : spread(session.count, MOMENTS)) {
      points.push(...robot.links(session.at("q", k)).map(originOf));
      if (session.groups.has("x_des")) points.push(this.target(k));
    }
    const flat = session.axes.length === 2;
    const gravity = [1, 2, 3].map((i) => -Number(session.values.get(`gravity[${i}]`) ?? 0));
    const vertical = base(gravity.map(Math.abs).indexOf(Math.max(...gravity.map(Math.abs), 1e-9)));
    const up = Math.hypot(...gravity) ? vertical.map((n) => n * Math.sign(gravity[vertical.indexOf(1)])) : base(2);
    const { centre, radius } = this.reach;
    if (facts.links.length > 1 && Number.isFinite(radius))
      for (const sign of [-0.5, 0.5])
        for (const axis of flat ? session.axes : [0, 1]) points.push(plus(centre, sign * radius, base(axis)));
    const across = base((up.findIndex(Boolean) + 1) % 3);
    let view = { front: plus(plus(across, -1, cross(up, across)), 0.55, up), vertical: up };
    if (flat) {
      const normal = base(session.free[0]), inside = Math.abs(dot(normal, up)) < 0.5;
      const upright = inside ? up : base(session.axes[1]);
      const right = cross(upright, normal);
      view = { front: normal.map((n) => n * (right[0] + right[1] + right[2] > 0 ? 1 : -1)), vertical: upright };
    }
    return new Camera(view, flat, points.filter((point) => point.every(Number.isFinite)));
  }

  /** The position of the end effector in sample k. */
  /** @type {(k: number) => number[]} */
  end(k) {
    return this.robot.end(this.session.at("q", k));
  }

  /** The position of the target; on uncontrolled axes that of the end effector. */
  target(k = this.session.now) {
    const { session } = this, place = this.end(k), given = session.target("x_des", k);
    if (given.length) session.axes.forEach((axis, i) => (place[axis] = given[i]));
    return place;
  }

  /** Angle between the end effector's orientation and its target in sample k, rad. */
  /** @param {number} k */
  turnError(k) {
    const { session, robot } = this, place = robot.frame(robot.links(session.at("q", k)));
    return angleBetween(place, rotation(session.target("quat_des", k)));
  }

  /** Set a variable; a refusal is shown. */
  /** @type {(name: string, value: Value | number[]) => void} */
  tell(name, value) {
    this.order(() => this.session.set(name, value));
  }

  /** Do what the user asks for. */
  /** @type {(action: () => void) => void} */
  order(action) {
    this.session.message = "";
    this.attempt(action);
    this.label();
  }

  /** @param {() => void} action */
  attempt(action) {
    try {
      action();
    } catch (refused) {
      this.session.message = refused instanceof Error ? refused.message : String(refused);
      this.session.play(false);
    }
  }

  /** Say on buttons what they do now. */
  label() {
    const { playing, recorded } = this.session;
    const texts = { play: playing ? "Pause" : "Play", record: recorded ? `Stop recording (${recorded} samples)` : "Record" };
    for (const [id, text] of Object.entries(texts)) if (byId(id).textContent !== text) byId(id).textContent = text;
  }

  panels() {
    const { session } = this, { facts } = session, units = unitsOf(facts.joints);
    /** @type {Record<string, (line: number) => (number | null)[]>} */
    const limits = {
      q: (line) => ["q_min", "q_max"].map((side) => Number(session.values.get(`${side}[${line + 1}]`))),
      v: () => [],
      tau: (line) => [-(facts.joints[line].effort ?? NaN), facts.joints[line].effort ?? NaN],
    };
    /** @type {Panel[]} */
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
      panels.push({ title: "angle from the target orientation, rad", value: (k) => this.turnError(k), lines: [0], log: true, limits: limits.v });
    return panels.filter(({ lines }) => lines.length);
  }

  listen() {
    /** @type {(id: string, action: () => void) => void} */
    const on = (id, action) => byId(id).addEventListener("click", action);
    const { session } = this, play = () => this.order(() => session.play(!session.playing));
    on("play", play);
    on("step", () => this.order(() => {
      if (session.playing) session.play(false);
      session.step();
    }));
    on("reset", () => this.restart(false));
    on("defaults", () => this.restart(true));
    on("home", () => this.camera.reset());
    on("download", () => session instanceof Session && save(new Blob([mcap(session, this.robot)]), `${session.facts.name}.mcap`));
    on("picture", () => {
      this.show(); // a scene is kept until the browser has shown it
      byId("scene").toBlob((/** @type {Blob} */ content) => save(content, `${session.facts.name || "robot"}.png`));
    });
    if (session instanceof Remote) on("record", () => this.order(() => session.record()));
    if (session instanceof Replay) {
      byId("scrub").max = String(session.duration);
      byId("scrub").addEventListener("input", () => this.order(() => session.seek(Number(byId("scrub").value))));
      byId("loop").addEventListener("change", () => (session.loops = byId("loop").checked));
    }
    addEventListener("keydown", (event) => {
      const fields = `input${event.key === " " ? ":not([type=range])" : ""}, select, button, summary`;
      const typing = event.target instanceof HTMLElement && event.target.matches(fields);
      if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === " ") play();
      else if (event.key === "Home") this.camera.reset();
      else return;
      event.preventDefault();
    });
  }

  /** @param {boolean} all */
  restart(all) {
    this.order(() => this.session.startAgain(all));
    this.curves.chosen = null;
  }

  /** @param {number} now ms */
  frame(now) {
    const { session } = this, passed = (now - this.before) / 1000;
    this.before = now;
    if (session.playing) this.attempt(() => session.advance(passed, Number(byId("speed").value)));
    this.slow = passed > SLOW ? this.slow + 1 : 0;
    if (this.slow === SLOW_FRAMES && this.scene) this.scene.fineness = 1;
    this.show();
    requestAnimationFrame((next) => this.frame(next));
  }

  show() {
    const { session, robot, scene, camera } = this, k = this.curves.sample, q = session.at("q", k);
    const links = robot.links(q), style = getComputedStyle(byId("scene").parentElement);
    const colour = (/** @type {string} */ name) => style.getPropertyValue(name).trim();
    camera.follow(originOf(robot.frame(links)));
    const target = this.target(k);
    if (!this.handle.drag && target.every(Number.isFinite)) camera.follow(target);
    if (scene) {
      const flat = this.addFloor(scene, fractions(colour("--hair")));
      session.facts.shapes.forEach(({ link, place, colour: own }, i) => {
        const model = multiply(links[link], place);
        scene.addSolid(i + 1, model, [...own, 1]);
        if (flat && scene.fineness > 1) scene.addSolid(i + 1, multiply(flat, model), [...fractions(colour("--shade")), 2]);
      });
      this.addTrail(scene, k, links);
      scene.draw(camera, fractions(colour("--scene")), Number(colour("--bright")));
    }
    const stopped = robot.atLimit(q, session.values);
    const stuck = robot.sticking(session.at("v", k), session.values).filter((joint) => !stopped.includes(joint));
    const sticks = stuck.length ? `${stuck.map(({ name }) => name).join(", ")}: held by friction` : "";
    if (this.curves.cursor !== null || this.before - this.drawn > 1000 * PANEL) {
      this.curves.draw([colour("--ink"), colour("--hair")]);
      const turns = session.groups.has("quat_des");
      this.readout.show(k, stopped, this.places(k), turns ? this.turnError(k) : NaN);
      this.lines = this.verdict?.lines(turns ? this.turnError(session.count - 1) : NaN) ?? [];
      this.controls?.show();
      this.label();
      byId("time").textContent = `${session.time(k).toFixed(3)} s`;
      if (session instanceof Session && location.protocol !== "about:" && decodeURI(location.hash.slice(1)) !== session.state)
        history.replaceState(null, "", `#${session.state}`);
      if (session instanceof Replay) byId("scrub").value = String(session.moment);
      this.drawn = this.before;
    }
    const blind = scene ? "" : "this browser shows no 3D: it has no WebGL 2";
    const unsaid = this.lines.some((line) => line.includes("sticks")) ? "" : sticks;
    const notes = [blind, session.message, session.notice, ...this.lines, unsaid, this.handle.hint];
    const text = notes.filter(Boolean).join("\n");
    if (byId("message").textContent !== text) byId("message").textContent = text;
  }

  /** The readout of sample k besides the joints, m. */
  /** @type {(k: number) => Record<string, number[]>} */
  places(k) {
    const { groups, facts } = this.session;
    if (facts.links.length === 1) return {};
    return { "end effector": this.end(k), ...(groups.has("x_des") && { target: this.target(k) }) };
  }

  /** Draw axes at the root and, below a robot in space, a floor; return what casts a shadow onto that. */
  /** @type {(scene: Scene, colour: number[]) => Float64Array | null} */
  addFloor(scene, colour) {
    const { camera } = this, up = camera.view.vertical, size = camera.size;
    AXIS_COLOURS.forEach((own, i) => scene.addLine([[0, 0, 0], plus([0, 0, 0], 0.1 * size, base(i))], [...own, 0.9], 1.5, scene.ground));
    if (camera.flat) return null;
    const normal = up.findIndex(Boolean), [one, two] = [1, 2].map((i) => base((normal + i) % 3)), cell = 10 ** Math.floor(Math.log10(size / 2));
    for (let i = -TILES; i <= TILES; i++)
      for (const [a, b] of [[one, two], [two, one]]) {
        const [from, to] = [-TILES, TILES].map((end) => plus(plus([0, 0, 0], end * cell, a), i * cell, b));
        scene.addLine([from, to], [...colour, 1], 1, scene.ground);
      }
    const shadow = placed([0, 0, 0]);
    shadow[5 * normal] = 0;
    return shadow;
  }

  /** Everything drawn besides the robot. */
  /** @type {(scene: Scene, k: number, links: Float64Array[]) => void} */
  addTrail(scene, k, links) {
    const { session, robot, camera } = this, { facts } = session, size = camera.size;
    const first = session.nearest(session.time(k) - TRAIL), stride = Math.max(1, Math.ceil((k - first) / 60));
    const trail = [];
    for (let i = first; i <= k; i += stride) trail.push(this.end(i));
    scene.addLine(this.path, [0.5, 0.55, 0.6, 0.7], 1);
    scene.addLine([...trail, originOf(robot.frame(links))], [0, 0.447, 0.698, 1], 2);
    if (facts.links.length > 1 && Number.isFinite(this.reach.radius)) {
      const normals = session.axes.length === 2 ? session.free : [0, 1, 2], { centre, radius } = this.reach;
      for (const axis of normals) scene.addLine(circle(centre, radius, base((axis + 1) % 3), base((axis + 2) % 3)), [0.5, 0.55, 0.6, 0.4], 1);
    }
    if (!session.groups.has("x_des")) return;
    scene.addSolid(0, placed(this.target(k), 0.018 * size), [0.835, 0.369, 0, 0.92]);
    if (!session.groups.has("quat_des")) return;
    const ends = [robot.frame(links), multiply(placed(this.target(k)), rotation(session.target("quat_des", k)))];
    AXIS_COLOURS.forEach((axisColour, axis) => {
      if (this.handle.turns) scene.addLine(this.handle.ring(axis), [...axisColour, 0.8], 1.2);
      for (const end of ends) {
        const from = originOf(end);
        scene.addLine([from, plus(from, 0.09 * size, transform(end, base(axis), 0))], [...axisColour, 1], 1.8);
      }
    });
  }
}

/** Let the browser save a file. */
/** @type {(content: Blob, name: string) => void} */
function save(content, name) {
  const link = document.createElement("a");
  Object.assign(link, { href: URL.createObjectURL(content), download: name }).click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

/** @param {string} colour as #rrggbb */
function fractions(colour) {
  return [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16) / 255);
}

/** Numbers of samples, some so many of them, from the first to the last. */
/** @type {(count: number, some: number) => number[]} */
function spread(count, some) {
  const most = Math.min(count, some);
  return Array.from({ length: most }, (_, i) => Math.round((i * (count - 1)) / Math.max(most - 1, 1)));
}

/** The source of motion: an engine or samples in this page, or its server. */
/** @type {(facts: Facts) => Promise<Session | Replay | Remote>} */
async function makeSession(facts) {
  if (byId("engine")) return new Session(facts, await Engine.load(new Uint8Array(await unpacked("engine"))));
  if (byId("samples")) return new Replay(facts, await unpacked("samples"));
  return Remote.connect(facts);
}

async function main() {
  const facts = /** @type {Facts} */ (JSON.parse(byId("facts").textContent));
  const [session, meshes] = await Promise.all([makeSession(facts), unpacked("meshes")]);
  const app = new App(facts, session, meshes);
  Object.assign(globalThis, { arm: app.session });
  byId("scene").dataset.ready = "";
}

main().catch((error) => {
  byId("message").textContent = error instanceof Error ? error.message : String(error);
});
