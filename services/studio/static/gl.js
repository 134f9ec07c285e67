// Draws triangle meshes with WebGL 2: light is worked out at the vertices, so that a processor without a graphics card
// keeps up too.

import { IDENTITY, multiply } from "./math.js";

const KEY = [0.35, -0.5, 0.8]; // towards the light that casts shadows
const GROUND = 1; // in the stencil
const SHADE = 0.2;
const LIFT = 0.0004; // m of a shadow over its ground
const FLAT = [1, 0, 0, 0, 0, 1, 0, 0, -KEY[0] / KEY[2], -KEY[1] / KEY[2], 0, 0, 0, 0, LIFT, 1];

const VERTEX = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec3 colour;
uniform mat4 view, model;
uniform vec4 tint;
uniform float lit;
out vec4 shade;
void main() {
  vec3 n = normalize(mat3(model) * normal);
  float light = 0.50 + 0.16 * n.z + 0.40 * max(dot(n, normalize(vec3(${KEY}))), 0.0)
    + 0.12 * max(dot(n, normalize(vec3(-0.7, 0.5, 0.25))), 0.0);
  shade = vec4(colour * tint.rgb * mix(1.0, light, lit), tint.a);
  gl_Position = view * model * vec4(position, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision mediump float;
in vec4 shade;
out vec4 result;
void main() { result = shade; }`;

function compile(gl, kind, source) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  return shader;
}

// Whether WebGL runs on the processor, where every pixel counts.
function drawnInSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return false;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

export class Renderer {
  constructor(canvas) {
    this.canvas = canvas;
    this.software = drawnInSoftware();
    this.coarse = 1; // share of the pixels, along each side, while something moves
    this.shadows = true; // while something moves
    this.mean = 0; // ms of a frame
    const gl = canvas.getContext("webgl2", { antialias: !this.software, alpha: false, stencil: true });
    if (!gl) throw new Error("This browser offers no WebGL 2. Use a newer one, or allow hardware acceleration.");
    this.gl = gl;
    const program = gl.createProgram();
    gl.attachShader(program, compile(gl, gl.VERTEX_SHADER, VERTEX));
    gl.attachShader(program, compile(gl, gl.FRAGMENT_SHADER, FRAGMENT));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.places = Object.fromEntries(
      ["view", "model", "tint", "lit"].map((name) => [name, gl.getUniformLocation(program, name)]),
    );
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  // A mesh {positions, normals, colours} of three vertices a triangle, or with `indices`, as the card keeps it.
  mesh({ positions, normals, colours, indices }) {
    const gl = this.gl;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const buffers = [positions, normals, colours].map((data, place) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
      return buffer;
    });
    if (indices) {
      buffers.push(gl.createBuffer());
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers[3]);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    }
    gl.bindVertexArray(null);
    return { array, buffers, indexed: Boolean(indices), count: indices ? indices.length : positions.length / 3 };
  }

  move(mesh, positions, normals) {
    const gl = this.gl;
    [positions, normals].forEach((data, place) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, mesh.buffers[place]);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, data);
    });
  }

  recolour(mesh, colours) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, mesh.buffers[2]);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, colours);
  }

  release(mesh) {
    this.gl.deleteVertexArray(mesh.array);
    for (const buffer of mesh.buffers) this.gl.deleteBuffer(buffer);
  }

  // Told how long a frame took while something moves: without a graphics card fewer pixels are drawn until it is fast,
  // and if that is not enough no shadows.
  pace(milliseconds, slowest) {
    if (!this.software) return;
    this.mean += 0.2 * (milliseconds - this.mean);
    if (this.mean <= 0.85 * slowest) return;
    if (this.coarse > 0.45) this.coarse = Math.max(0.45, 0.8 * this.coarse);
    else this.shadows = false;
    this.mean = 0.7 * slowest;
  }

  // Fits the frame to the space that the page gives it.
  resize(moving) {
    const ratio = this.software ? (moving ? this.coarse : 1) : Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
  }

  // Draws views {matrix, things, left, width} beside each other, `left` and `width` as shares of the canvas. Things are
  // {mesh, model, tint, alpha, lit}; those that are seen through come last. A thing that `casts` has a shadow on one that
  // is the `ground`, at height zero; what is `above` is seen through everything.
  draw(views, background, moving) {
    const gl = this.gl;
    this.resize(moving);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    for (const view of views) this.#view(view, this.shadows || !moving);
  }

  #view({ matrix, things, left = 0, width = 1 }, shadows) {
    const gl = this.gl;
    gl.viewport(Math.round(left * this.canvas.width), 0, Math.round(width * this.canvas.width), this.canvas.height);
    gl.uniformMatrix4fv(this.places.view, false, matrix);
    const clear = (thing) => (thing.alpha ?? 1) < 1;
    gl.disable(gl.BLEND);
    gl.depthMask(true);
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.ALWAYS, GROUND, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.REPLACE);
    for (const thing of things) if (thing.ground) this.#draw(thing);
    gl.disable(gl.STENCIL_TEST);
    for (const thing of things) if (!thing.ground && !thing.above && !clear(thing)) this.#draw(thing);
    gl.enable(gl.BLEND);
    gl.depthMask(false);
    // The stencil keeps a shadow on the ground, and lets none fall twice on one place.
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.EQUAL, GROUND, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    for (const thing of things) if (shadows && thing.casts) this.#draw({ mesh: thing.mesh, model: multiply(FLAT, thing.model ?? IDENTITY), tint: [0, 0, 0], alpha: SHADE, lit: 0 });
    gl.disable(gl.STENCIL_TEST);
    for (const thing of things) if (!thing.above && clear(thing)) this.#draw(thing);
    gl.disable(gl.DEPTH_TEST);
    for (const thing of things) if (thing.above) this.#draw(thing);
    gl.enable(gl.DEPTH_TEST);
    gl.depthMask(true);
  }

  #draw({ mesh, model = IDENTITY, tint = [1, 1, 1], alpha = 1, lit = 1 }) {
    const gl = this.gl;
    gl.uniformMatrix4fv(this.places.model, false, model);
    gl.uniform4f(this.places.tint, ...tint, alpha);
    gl.uniform1f(this.places.lit, lit);
    gl.bindVertexArray(mesh.array);
    if (mesh.indexed) gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_INT, 0);
    else gl.drawArrays(gl.TRIANGLES, 0, mesh.count);
  }
}
