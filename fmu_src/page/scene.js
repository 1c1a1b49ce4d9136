/** The scene in 3D, by WebGL 2: triangles with a colour, and lines of some pixels. */

import { plus, unit } from "./matrices.js";

/** @typedef {import("./camera.js").Camera} Camera */

const SOLID = [
  `#version 300 es
  uniform mat4 view, model; uniform vec3 low; uniform float size;
  layout(location = 0) in vec3 vertex; layout(location = 1) in vec3 normal;
  out vec3 rotated;
  void main() {
    rotated = mat3(model) * normal;
    gl_Position = view * model * vec4(low + size * vertex, 1.0);
  }`,
  `#version 300 es
  precision highp float;
  uniform vec3 light; uniform vec4 colour; uniform float bright;
  in vec3 rotated; out vec4 shown;
  void main() {
    float lit = dot(normalize(rotated), light);
    shown = colour.a > 1.0 ? vec4(colour.rgb, 1.0) : vec4(mix(colour.rgb, vec3(1.0), bright) * (0.55 + 0.35 * lit + 0.15 * max(lit, 0.0)), colour.a);
  }`,
];
const LINES = [
  `#version 300 es
  uniform mat4 view; uniform vec2 pixel;
  layout(location = 0) in vec3 from; layout(location = 1) in vec3 to;
  layout(location = 2) in vec4 colour; layout(location = 3) in float width;
  out vec4 tint;
  void main() {
    vec4 a = view * vec4(from, 1.0), b = view * vec4(to, 1.0);
    vec2 along = normalize((b.xy / b.w - a.xy / a.w) / pixel + vec2(1e-9, 0.0));
    float side = float(gl_VertexID & 1) * 2.0 - 1.0;
    gl_Position = gl_VertexID < 2 ? a : b;
    gl_Position.xy += side * width * vec2(-along.y, along.x) * pixel * gl_Position.w;
    tint = colour;
  }`,
  `#version 300 es
  precision mediump float;
  in vec4 tint; out vec4 shown;
  void main() { shown = tint; }`,
];
const CREASE = 0.8; // cosine of the angle between two faces below which their edge is sharp
const LINE_SIZE = 11; // numbers for each line

export class Scene {
  /** @type {number[]} lines of the next picture */
  lines = [];
  /** @type {number[]} lines of the next picture, below everything else */
  ground = [];
  /** @type {{mesh: number, model: Float64Array, colour: number[]}[]} */
  solids = [];
  fineness = 2; // computed pixels for each shown pixel, along each side

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {WebGL2RenderingContext} gl
   * @param {Facts} facts
   * @param {ArrayBuffer} meshes vertices and triangles, one mesh after the other
   */
  constructor(canvas, gl, facts, meshes) {
    this.gl = gl;
    this.canvas = canvas;
    this.solid = this.program(SOLID);
    this.line = this.program(LINES);
    this.facts = facts;
    let offset = 0;
    this.meshes = facts.meshes.map((mesh) => {
      const vertices = new Uint16Array(meshes, offset, 3 * mesh.vertices);
      offset += 4 * Math.ceil(vertices.byteLength / 4);
      const triangles = new Uint32Array(meshes, offset, 3 * mesh.triangles);
      offset += triangles.byteLength;
      return { ...mesh, ...this.upload(vertices, triangles) };
    });
    this.linesBuffer = /** @type {WebGLBuffer} */ (gl.createBuffer());
    this.linesArray = gl.createVertexArray();
    gl.bindVertexArray(this.linesArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.linesBuffer);
    [[3, 0], [3, 3], [4, 6], [1, 10]].forEach(([size, first], i) => {
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, size, gl.FLOAT, false, 4 * LINE_SIZE, 4 * first);
      gl.vertexAttribDivisor(i, 1);
    });
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  /** @type {(sources: string[]) => WebGLProgram} */
  program(sources) {
    const { gl } = this, program = /** @type {WebGLProgram} */ (gl.createProgram());
    sources.forEach((source, i) => {
      const shader = /** @type {WebGLShader} */ (gl.createShader(i ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER));
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    });
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS))
      throw new Error(`the scene cannot be drawn: ${gl.getProgramInfoLog(program)}`);
    return program;
  }

  /** @type {(vertices: Uint16Array, triangles: Uint32Array) => {array: WebGLVertexArrayObject | null, count: number}} */
  upload(vertices, triangles) {
    const { gl } = this, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const { corners, normals, indices } = smoothed(vertices, triangles);
    for (const [i, [content, type]] of /** @type {const} */ ([[corners, gl.UNSIGNED_SHORT], [normals, gl.BYTE]]).entries()) {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, content, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, 3, type, true, 4 * content.BYTES_PER_ELEMENT, 0);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    return { array, count: indices.length };
  }

  /**
   * Add a mesh with red, green, blue and opacity. With an opacity below 1 it is drawn in front of opaque meshes, and
   * with 2 it is drawn unlit behind them.
   */
  /** @type {(mesh: number, model: Float64Array, colour: number[]) => void} */
  addSolid(mesh, model, colour) {
    this.solids.push({ mesh, model, colour });
  }

  /** Add lines from point to point with a colour, and a width in pixels. */
  /** @type {(points: number[][], colour: number[], width: number, into?: number[]) => void} */
  addLine(points, colour, width, into = this.lines) {
    for (let i = 1; i < points.length; i++) into.push(...points[i - 1], ...points[i], ...colour, width);
  }

  /** Draw what was added; `bright` blends the colours towards white. */
  /** @type {(camera: Camera, background: number[], bright: number) => void} */
  draw(camera, background, bright) {
    const { gl, canvas } = this;
    const ratio = Math.max(Math.min(devicePixelRatio, 2), this.fineness);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((n) => Math.max(1, Math.round(n * ratio)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    camera.aspect = width / height;
    const view = camera.matrix();
    gl.viewport(0, 0, width, height);
    gl.clearColor(background[0], background[1], background[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const light = unit(plus(plus(camera.back, 0.5, camera.up), 0.3, camera.right));
    this.drawLines(this.ground, view, ratio / width, ratio / height);
    this.drawSolids(this.solids.filter(({ colour }) => colour[3] > 1), view, light, bright);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    this.drawSolids(this.solids.filter(({ colour }) => colour[3] === 1), view, light, bright);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.enable(gl.CULL_FACE); // otherwise back faces would be visible in part
    this.drawSolids(this.solids.filter(({ colour }) => colour[3] < 1), view, light, bright);
    gl.disable(gl.CULL_FACE);
    gl.disable(gl.BLEND);
    this.drawLines(this.lines, view, ratio / width, ratio / height);
    [this.lines, this.ground, this.solids] = [[], [], []];
  }

  /** @type {(lines: number[], view: Float64Array, across: number, up: number) => void} */
  drawLines(lines, view, across, up) {
    const { gl } = this;
    gl.enable(gl.BLEND);
    gl.useProgram(this.line);
    gl.bindVertexArray(this.linesArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.linesBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(lines), gl.DYNAMIC_DRAW);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.line, "view"), false, new Float32Array(view));
    gl.uniform2f(gl.getUniformLocation(this.line, "pixel"), across, up);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, lines.length / LINE_SIZE);
    gl.disable(gl.BLEND);
  }

  /** @type {(solids: Scene["solids"], view: Float64Array, light: number[], bright: number) => void} */
  drawSolids(solids, view, light, bright) {
    const { gl, solid } = this;
    /** @param {string} name */
    const at = (name) => gl.getUniformLocation(solid, name);
    gl.useProgram(solid);
    gl.uniformMatrix4fv(at("view"), false, new Float32Array(view));
    gl.uniform3fv(at("light"), light);
    gl.uniform1f(at("bright"), bright);
    for (const { mesh, model, colour } of solids) {
      const { low, size, array, count } = this.meshes[mesh];
      gl.bindVertexArray(array);
      gl.uniformMatrix4fv(at("model"), false, new Float32Array(model));
      gl.uniform4fv(at("colour"), colour);
      gl.uniform3fv(at("low"), low);
      gl.uniform1f(at("size"), size);
      gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 0);
    }
  }
}

/**
 * The drawn parts of a mesh: points, each with its normal and padded to four numbers, and the corners of
 * triangles among them. A vertex is there once for each normal that it has, which is the mean of the faces
 * about it that are not at a sharp edge to the corner's own.
 * @param {Uint16Array} vertices
 * @param {Uint32Array} triangles
 */
function smoothed(vertices, triangles) {
  const { length } = triangles, count = vertices.length / 3;
  const faces = facesOf(vertices, triangles), [begins, around] = facesAround(count, triangles);
  const corners = new Uint16Array(4 * length), normals = new Int8Array(4 * length), indices = new Uint32Array(length);
  const newest = new Int32Array(count).fill(-1), older = new Int32Array(length); // drawn vertices of each vertex
  let made = 0;
  for (let corner = 0; corner < length; corner++) {
    const vertex = triangles[corner], own = corner - (corner % 3);
    let x = 0, y = 0, z = 0;
    for (let i = begins[vertex]; i < begins[vertex + 1]; i++) {
      const f = around[i];
      if (f !== own && !(cosine(faces, own, f) > CREASE)) continue;
      [x, y, z] = [x + faces[f], y + faces[f + 1], z + faces[f + 2]];
    }
    const scale = 127 / (Math.hypot(x, y, z) || 1);
    normals.set([x * scale, y * scale, z * scale], 4 * made);
    let same = newest[vertex];
    while (same >= 0 && [0, 1, 2].some((i) => normals[4 * same + i] !== normals[4 * made + i])) same = older[same];
    if (same < 0) {
      corners.set(vertices.subarray(3 * vertex, 3 * vertex + 3), 4 * made);
      [older[made], newest[vertex], same] = [newest[vertex], made, made];
      made += 1;
    }
    indices[corner] = same;
  }
  return { corners: corners.subarray(0, 4 * made), normals: normals.subarray(0, 4 * made), indices };
}

/** Normals of triangles, with the length of twice the area; a normal has the index of the triangle's first corner. */
/** @type {(vertices: Uint16Array, triangles: Uint32Array) => Float64Array} */
function facesOf(vertices, triangles) {
  const faces = new Float64Array(triangles.length);
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [3 * triangles[t], 3 * triangles[t + 1], 3 * triangles[t + 2]];
    const [ux, uy, uz] = [vertices[b] - vertices[a], vertices[b + 1] - vertices[a + 1], vertices[b + 2] - vertices[a + 2]];
    const [vx, vy, vz] = [vertices[c] - vertices[a], vertices[c + 1] - vertices[a + 1], vertices[c + 2] - vertices[a + 2]];
    [faces[t], faces[t + 1], faces[t + 2]] = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
  }
  return faces;
}

/** The cosine of the angle between two faces; NaN if one has no area. */
/** @type {(faces: Float64Array, f: number, g: number) => number} */
function cosine(faces, f, g) {
  const [x, y, z] = [faces[f], faces[f + 1], faces[f + 2]], [u, v, w] = [faces[g], faces[g + 1], faces[g + 2]];
  return (x * u + y * v + z * w) / Math.sqrt((x * x + y * y + z * z) * (u * u + v * v + w * w));
}

/** First corners of the triangles at each of `count` vertices, and the index at which those of a vertex begin. */
/** @type {(count: number, triangles: Uint32Array) => Uint32Array[]} */
function facesAround(count, triangles) {
  const begins = new Uint32Array(count + 1), around = new Uint32Array(triangles.length);
  for (const vertex of triangles) begins[vertex + 1] += 1;
  for (let i = 0; i < count; i++) begins[i + 1] += begins[i];
  const next = begins.slice();
  triangles.forEach((vertex, corner) => (around[next[vertex]++] = corner - (corner % 3)));
  return [begins, around];
}
