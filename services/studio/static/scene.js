// What is seen: hand, object, constraints and contacts, as things for the renderer.

import { add, cross, dot, multiply, norm, pose, rotate, scale, sub, toWorld, unit, perpendicular, IDENTITY } from "./math.js";
import * as shapes from "./shapes.js";
import { Skin } from "./skin.js";
import { rgb } from "./theme.js";

const OBJECT = [0.95, 0.64, 0.28];
const AVOID = [0.8, 0.22, 0.22];
const TOUCHING = [0.13, 0.74, 0.63];
const HEADING = [0.22, 0.4, 0.86];
const COUNTS = [0.1, 0.62, 0.85];
const PATH = [0.53, 0.3, 0.75];
const FORCE = [0.98, 0.8, 0.12];
const GHOST = [0.22, 0.4, 0.86];

export const ARROW = 0.1; // length of the approach arrow, m
const FULL = 2; // N at which a link has most of its colour
const LEAST = 0.05; // N from which a force is drawn
const FORCE_LENGTH = 0.015; // m per newton
const LONGEST = 0.09; // m
const TABLE = 0.3; // m
const HINT = 0.55; // share of its colour that a brush shows before it paints
const BEHIND = 0.4; // opacity of a motion that another is laid over

// The matrix that lays a mesh along +z onto a line from a point.
function along(start, direction, stretch = 1) {
  const x = perpendicular(direction);
  const y = cross(direction, x);
  return [...x, 0, ...y, 0, ...scale(direction, stretch), 0, ...start, 1];
}

// An object's mesh for drawing, painting and picking; `own` are three bytes of colour for each vertex, if it has any.
export class Body {
  constructor(renderer, vertices, faces, own = null) {
    this.renderer = renderer;
    this.vertices = vertices;
    this.faces = faces;
    const mesh = shapes.smooth(vertices, faces);
    this.points = mesh.positions;
    this.vertex = mesh.vertex;
    this.colours = mesh.colours;
    this.bare = new Float32Array(this.colours.length); // without paint
    mesh.vertex.forEach((vertex, i) => this.bare.set(own ? [0, 1, 2].map((k) => own[3 * vertex + k] / 255) : OBJECT, 3 * i));
    this.normals = mesh.normals;
    this.mesh = renderer.mesh(mesh);
    this.paint(null);
    this.radius = 0;
    for (let i = 0; i < vertices.length; i += 3) this.radius = Math.max(this.radius, Math.hypot(vertices[i], vertices[i + 1], vertices[i + 2]));
  }

  // Colours by a label for each vertex; all alike without labels.
  paint(avoid) {
    this.vertex.forEach((vertex, i) => this.#colour(this.colours, 3 * i, Boolean(avoid?.[vertex])));
    this.renderer.recolour(this.mesh, this.colours);
  }

  // Shows what a brush at a point of the object frame would paint; nothing without a point.
  preview(point, radius, avoid) {
    if (!point && !this.previewed) return;
    this.previewed = Boolean(point);
    const colours = point ? this.colours.slice() : this.colours;
    if (point) this.#within(point, radius, (i) => this.#colour(colours, i, avoid, HINT));
    this.renderer.recolour(this.mesh, colours);
  }

  // Moves the colour at a place of an array by a share towards the paint, or what is below it.
  #colour(colours, i, avoid, share = 1) {
    for (let k = 0; k < 3; k++) colours[i + k] += share * ((avoid ? AVOID[k] : this.bare[i + k]) - colours[i + k]);
  }

  #within(point, radius, act) {
    for (let i = 0; i < this.points.length; i += 3) {
      const [x, y, z] = [this.points[i] - point[0], this.points[i + 1] - point[1], this.points[i + 2] - point[2]];
      if (x * x + y * y + z * z <= radius * radius) act(i);
    }
  }

  // Colours what a brush at a point of the object frame touches, until the server's answer is there.
  brush(point, radius, avoid) {
    this.#within(point, radius, (i) => this.#colour(this.colours, i, avoid));
    this.renderer.recolour(this.mesh, this.colours);
  }

  // Where a ray of the object frame meets the surface first: {point, normal}, or null.
  hit(origin, direction) {
    let nearest = Infinity;
    let normal = null;
    const { vertices: v, faces } = this;
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
      const e1x = v[b] - v[a], e1y = v[b + 1] - v[a + 1], e1z = v[b + 2] - v[a + 2];
      const e2x = v[c] - v[a], e2y = v[c + 1] - v[a + 1], e2z = v[c + 2] - v[a + 2];
      const px = direction[1] * e2z - direction[2] * e2y;
      const py = direction[2] * e2x - direction[0] * e2z;
      const pz = direction[0] * e2y - direction[1] * e2x;
      const determinant = e1x * px + e1y * py + e1z * pz;
      if (Math.abs(determinant) < 1e-14) continue;
      const tx = origin[0] - v[a], ty = origin[1] - v[a + 1], tz = origin[2] - v[a + 2];
      const u = (tx * px + ty * py + tz * pz) / determinant;
      if (u < 0 || u > 1) continue;
      const qx = ty * e1z - tz * e1y, qy = tz * e1x - tx * e1z, qz = tx * e1y - ty * e1x;
      const w = (direction[0] * qx + direction[1] * qy + direction[2] * qz) / determinant;
      if (w < 0 || u + w > 1) continue;
      const far = (e2x * qx + e2y * qy + e2z * qz) / determinant;
      if (far > 1e-6 && far < nearest) {
        nearest = far;
        normal = unit([e1y * e2z - e1z * e2y, e1z * e2x - e1x * e2z, e1x * e2y - e1y * e2x]);
      }
    }
    if (!normal) return null;
    return { point: add(origin, scale(direction, nearest)), normal: dot(normal, direction) > 0 ? scale(normal, -1) : normal };
  }

  release() {
    this.renderer.release(this.mesh);
  }
}

export class Scene {
  constructor(renderer) {
    this.renderer = renderer;
    this.hands = new Map(); // skins by hand
    this.body = null;
    this.table = renderer.mesh(shapes.table(TABLE));
    this.shaft = renderer.mesh(shapes.arrow(ARROW, 0.0028));
    this.force = renderer.mesh(shapes.arrow(1, 0.03));
    this.ball = renderer.mesh(shapes.capsules([{ start: [0, 0, 0], end: [0, 0, 0], radius: 0.006 }]));
    this.ring = renderer.mesh(shapes.ring(0.025));
    this.paths = new Map(); // beads by use
  }

  setHand(name, message) {
    this.hands.set(name, new Skin(this.renderer, message));
  }

  setObject(vertices, faces, own) {
    this.body?.release();
    this.body = new Body(this.renderer, vertices, faces, own);
  }

  // The hand, with shares of a colour on its links.
  #hand(use, hand, poses, tint, shares) {
    const skin = this.hands.get(hand);
    return skin ? [skin.thing(use, poses, tint, shares ?? new Array(skin.links).fill(0))] : [];
  }

  #arrow(tip, direction, tint, alpha) {
    return { mesh: this.shaft, model: along(sub(tip, scale(direction, ARROW)), direction), tint, alpha };
  }

  #path(use, points, place, alpha) {
    const key = JSON.stringify(points);
    let known = this.paths.get(use);
    if (known?.key !== key) {
      if (known) this.renderer.release(known.mesh);
      known = { key, mesh: this.renderer.mesh(shapes.beads(points, 0.0035)) };
      this.paths.set(use, known);
    }
    return { mesh: known.mesh, model: pose(place.position, place.quaternion), tint: PATH, alpha };
  }

  #table(center) {
    return { mesh: this.table, model: [...IDENTITY.slice(0, 12), center[0], center[1], 0, 1], tint: rgb("--table"), lit: 0, ground: true };
  }

  // A reference pose, which is given in the object's frame.
  #ghost(use, hand, links, place) {
    const turned = {
      position: links.position.map((point) => toWorld(place, point)),
      quaternion: links.quaternion.map((turn) => product(place.quaternion, turn)),
    };
    const whole = new Array(links.position.length).fill(1);
    return this.#hand(use, hand, turned, GHOST, whole).map((thing) => ({ ...thing, alpha: 0.28 }));
  }

  // Things while constraints are edited. `arrow`: {tip, direction} in the world; `brush`: {point, normal} in the object's
  // frame and {radius, avoid} of the brush over it, or null.
  editing(state, arrow, handles, brush) {
    const place = state.rest;
    const things = [this.#table(place.position)];
    const model = pose(place.position, place.quaternion);
    if (this.body) things.push({ mesh: this.body.mesh, model, casts: true });
    things.push(...this.#hand("hand", state.hand, state.start, TOUCHING).map((thing) => ({ ...thing, casts: true })));
    // An arrow that the rules overrule is faint, and beside it is the one that counts.
    const counts = toWorld(place, state.active.position);
    things.push(this.#arrow(arrow.tip, arrow.direction, HEADING, state.active.overruled ? 0.3 : 1));
    if (state.active.overruled) things.push(this.#arrow(counts, rotate(place.quaternion, state.active.direction), COUNTS, 1));
    for (const [name, point] of Object.entries(handles.points))
      things.push({ mesh: this.ball, model: [...IDENTITY.slice(0, 12), ...point, 1], tint: name === handles.hover ? [1, 0.8, 0.2] : HEADING, lit: 0.5 });
    if (state.path && state.asked.includes("trajectory")) things.push(this.#path("path", state.path, place, 1));
    if (state.pose && state.asked.includes("pose")) things.push(...this.#ghost("ghost", state.hand, state.pose, place));
    if (brush) things.push({ mesh: this.ring, model: multiply(model, along(brush.point, brush.normal).map((x, k) => (k < 12 ? brush.radius * x : x))), tint: brush.avoid ? AVOID : rgb("--ink"), lit: 0, above: true });
    return things;
  }

  // Things of a frame of a motion (see `Motion.at`) in one of the player's slots; faint where it is `behind` another.
  playing({ motion, body }, frame, slot, behind) {
    const place = frame.object;
    const things = [];
    if (frame.table && !behind) things.push(this.#table(motion.center));
    const solid = behind ? { alpha: BEHIND } : { casts: true };
    const faint = (alpha) => (behind ? BEHIND * alpha : alpha);
    things.push({ mesh: body.mesh, model: pose(place.position, place.quaternion), ...solid });
    const strengths = frame.forces.map(norm);
    const shares = strengths.map((strength) => (strength > LEAST ? 0.3 + 0.3 * Math.min(strength / FULL, 1) : 0));
    things.push(...this.#hand(`hand ${slot}`, motion.hand, frame.links, TOUCHING, shares).map((thing) => ({ ...thing, ...solid })));
    frame.forces.forEach((force, i) => {
      const strength = norm(force);
      if (strength > LEAST) things.push({ mesh: this.force, model: along(frame.links.position[i], scale(force, 1 / strength), Math.min(FORCE_LENGTH * strength, LONGEST)).map((x, k) => (k < 8 ? 0.09 * x : x)), tint: FORCE, alpha: faint(1) });
    });
    for (const { tip, direction } of motion.arrows)
      things.push(this.#arrow(toWorld(place, tip), rotate(place.quaternion, direction), HEADING, faint(0.6)));
    motion.paths.forEach((points, i) => things.push(this.#path(`path ${slot} ${i}`, points, place, faint(0.7))));
    motion.ghosts.forEach((links, i) => things.push(...this.#ghost(`ghost ${slot} ${i}`, motion.hand, links, place)));
    return things;
  }
}

function product(a, b) {
  return [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
    a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
}

