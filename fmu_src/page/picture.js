/** The picture: robot, target and paths in 3D. */

import { Camera } from "./camera.js";
import { byId, styled } from "./elements.js";
import { AXIS_COLOURS, Handle } from "./handle.js";
import { base, circle, cross, dot, multiply, originOf, placed, plus, rotation, transform } from "./matrices.js";
import { Scene } from "./scene.js";

/** @typedef {import("./robot.js").Robot} Robot */

const TRAIL = 1.5; // s
const TILES = 10; // tiles of the floor on each side
const MOMENTS = 30, PATH_POINTS = 600; // samples of a replay that the first view contains, and points of its path
const CORNER = 40, AXIS = 24, LETTER = 33; // pixels of the axes in the corner: their origin, length, and letters
const LETTERS = [
  [[[-3, -4], [3, 4]], [[-3, 4], [3, -4]]],
  [[[-3, 4], [0, 0], [3, 4]], [[0, 0], [0, -4]]],
  [[[-3, 4], [3, 4], [-3, -4], [3, -4]]],
]; // strokes of x, y and z, pixels
const SLOW = 0.04, SLOW_FRAMES = 10; // s: longer frames are slow; successive slow frames that end anti-aliasing

export class Picture {
  /**
   * @param {Robot} robot
   * @param {ArrayBuffer} meshes
   * @param {(name: string, value: number[]) => void} tell called with the new target
   */
  constructor(robot, meshes, tell) {
    this.robot = robot;
    const { session } = robot, canvas = byId("scene");
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    this.scene = gl && new Scene(canvas, gl, session.facts, meshes);
    this.path = session.steered ? [] : spread(session.count, PATH_POINTS).map((k) => robot.end(k));
    this.reach = robot.reach() ?? { centre: [0, 0, 0], radius: 1 };
    this.camera = this.makeCamera();
    this.handle = new Handle(canvas, this.camera, session, () => robot.target(), tell);
    this.slow = 0; // successive slow frames
  }

  makeCamera() {
    const { robot } = this, { session } = robot, { facts } = session, points = [...this.path];
    for (const k of session.steered ? [session.now] : spread(session.count, MOMENTS)) {
      points.push(...robot.links(k).map(originOf));
      if (session.groups.has("x_des")) points.push(robot.target(k));
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

  /** @type {(k: number, passed: number) => void} Show sample k, `passed` s after the previous picture. */
  show(k, passed) {
    const { robot, scene, camera } = this, links = robot.links(k), target = robot.target(k);
    this.slow = passed > SLOW ? this.slow + 1 : 0;
    camera.follow(originOf(links[robot.facts.frameLink]));
    if (!this.handle.drag && target.every(Number.isFinite)) camera.follow(target);
    if (!scene) return;
    if (this.slow === SLOW_FRAMES) scene.fineness = 1;
    const shadow = this.addFloor(scene, fractions(styled("--hair")));
    robot.facts.shapes.forEach(({ link, placement, colour }, i) => {
      const model = multiply(links[link], placement);
      scene.addSolid(i + 1, model, [...colour, 1]);
      if (shadow && scene.fineness > 1) scene.addSolid(i + 1, multiply(shadow, model), [...fractions(styled("--shade")), 2]);
    });
    this.addTrail(scene, k, links);
    this.addAxes(scene);
    scene.draw(camera, fractions(styled("--scene")), Number(styled("--bright")));
  }

  /** Draw axes at the root and, for a spatial robot, a floor; return the projection of its shadow. */
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

  /** @type {(scene: Scene) => void} Draw the directions of the root's axes in the lower left corner. */
  addAxes(scene) {
    const { camera } = this, { clientWidth, clientHeight } = scene.canvas, { centre, back, right, up } = camera;
    /** @type {(x: number, y: number) => number[]} The point some pixels to the right of the origin and above it. */
    const at = (x, y) => camera.meet((CORNER + x) / clientWidth, 1 - (CORNER + y) / clientHeight, centre, back) ?? centre;
    for (const axis of [0, 1, 2].sort((a, b) => back[a] - back[b])) { // the nearest last
      const [x, y] = [right[axis], up[axis]], colour = [...AXIS_COLOURS[axis], 1];
      if (Math.hypot(x, y) < 0.2) continue; // along the line of sight
      scene.addLine([at(0, 0), at(AXIS * x, AXIS * y)], colour, 1.5);
      for (const stroke of LETTERS[axis]) scene.addLine(stroke.map(([dx, dy]) => at(LETTER * x + dx, LETTER * y + dy)), colour, 1.2);
    }
  }

  /** @type {(scene: Scene, k: number, links: Float64Array[]) => void} Everything drawn besides the robot. */
  addTrail(scene, k, links) {
    const { robot, camera, handle } = this, { session } = robot, { facts } = session, size = camera.size;
    const first = session.nearest(session.time(k) - TRAIL), stride = Math.max(1, Math.ceil((k - first) / 60));
    const trail = [];
    for (let i = first; i <= k; i += stride) trail.push(robot.end(i));
    scene.addLine(this.path, [0.5, 0.55, 0.6, 0.7], 1);
    scene.addLine([...trail, originOf(links[facts.frameLink])], [0, 0.447, 0.698, 1], 2);
    if (facts.links.length > 1 && Number.isFinite(this.reach.radius)) {
      const normals = session.axes.length === 2 ? session.free : [0, 1, 2], { centre, radius } = this.reach;
      for (const axis of normals) scene.addLine(circle(centre, radius, base((axis + 1) % 3), base((axis + 2) % 3)), [0.5, 0.55, 0.6, 0.4], 1);
    }
    if (!session.groups.has("x_des")) return;
    scene.addSolid(0, placed(robot.target(k), 0.018 * size), [0.835, 0.369, 0, 0.92]);
    if (!session.groups.has("quat_des")) return;
    const ends = [links[facts.frameLink], multiply(placed(robot.target(k)), rotation(session.target("quat_des", k)))];
    AXIS_COLOURS.forEach((axisColour, axis) => {
      if (handle.turns) scene.addLine(handle.ring(axis), [...axisColour, 0.8], 1.2);
      for (const end of ends) {
        const from = originOf(end);
        scene.addLine([from, plus(from, 0.09 * size, transform(end, base(axis), 0))], [...axisColour, 1], 1.8);
      }
    });
  }
}

/** @param {string} colour as #rrggbb */
function fractions(colour) {
  return [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16) / 255);
}

/** @type {(count: number, some: number) => number[]} `some` evenly spaced sample numbers, from the first to the last.
 * */
function spread(count, some) {
  const most = Math.min(count, some);
  return Array.from({ length: most }, (_, i) => Math.round((i * (count - 1)) / Math.max(most - 1, 1)));
}
