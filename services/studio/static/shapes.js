// Triangle meshes {positions, normals, colours, indices} of simple bodies, and of an object's own mesh.

import { add, cross, norm, perpendicular, scale, sub, unit } from "./math.js";

const SECTIONS = 14;
const RINGS = 4; // of a half ball
const ALIKE = 0.9999; // cosine between normals that count as one

function white(count) {
  return new Float32Array(count).fill(1);
}

// Collects points with normals and triangles of their indices.
class Builder {
  positions = [];
  normals = [];
  indices = [];

  // Rings around an axis: `profile` lists {at: metres along, radius, along: the normal's part along the axis}.
  turned(start, axis, profile) {
    const x = perpendicular(axis);
    const y = cross(axis, x);
    const first = this.positions.length / 3;
    for (const { at, radius, along } of profile)
      for (let k = 0; k < SECTIONS; k++) {
        const angle = (2 * Math.PI * k) / SECTIONS;
        const out = add(scale(x, Math.cos(angle)), scale(y, Math.sin(angle)));
        this.positions.push(...add(start, add(scale(axis, at), scale(out, radius))));
        this.normals.push(...add(scale(axis, along), scale(out, Math.sqrt(Math.max(0, 1 - along * along)))));
      }
    for (let ring = 0; ring + 1 < profile.length; ring++)
      for (let k = 0; k < SECTIONS; k++) {
        const [a, b] = [first + ring * SECTIONS + k, first + ring * SECTIONS + ((k + 1) % SECTIONS)];
        this.indices.push(a, b, a + SECTIONS, b, b + SECTIONS, a + SECTIONS);
      }
  }

  capsule(start, end, radius) {
    const length = norm(sub(end, start));
    const axis = length > 1e-9 ? scale(sub(end, start), 1 / length) : [0, 0, 1];
    const profile = [];
    for (const top of [false, true])
      for (let k = 0; k <= RINGS; k++) {
        const angle = (Math.PI / 2) * (top ? k / RINGS : k / RINGS - 1);
        const along = Math.sin(angle);
        profile.push({ at: (top ? length : 0) + radius * along, radius: radius * Math.cos(angle), along });
      }
    this.turned(start, axis, profile);
  }

  build() {
    return {
      positions: new Float32Array(this.positions),
      normals: new Float32Array(this.normals),
      colours: white(this.positions.length),
      indices: new Uint32Array(this.indices),
    };
  }
}

// Capsules [{start, end, radius}] as one mesh.
export function capsules(list) {
  const builder = new Builder();
  for (const { start, end, radius } of list) builder.capsule(start, end, radius);
  return builder.build();
}

// An arrow of a given length from the origin along +z.
export function arrow(length, radius) {
  const builder = new Builder();
  const neck = length - Math.min(0.4 * length, 6 * radius);
  const flat = { along: -1 };
  builder.turned([0, 0, 0], [0, 0, 1], [{ at: 0, radius: 0, ...flat }, { at: 0, radius, ...flat }]);
  builder.turned([0, 0, 0], [0, 0, 1], [{ at: 0, radius, along: 0 }, { at: neck, radius, along: 0 }]);
  builder.turned([0, 0, 0], [0, 0, 1], [{ at: neck, radius, ...flat }, { at: neck, radius: 2.5 * radius, ...flat }]);
  builder.turned([0, 0, 0], [0, 0, 1], [{ at: neck, radius: 2.5 * radius, along: 0.4 }, { at: length, radius: 0, along: 0.4 }]);
  return builder.build();
}

// A ring of radius 1 around the origin, across +z.
export function ring(thickness) {
  const builder = new Builder();
  const count = 40;
  const at = (i) => [Math.cos((2 * Math.PI * i) / count), Math.sin((2 * Math.PI * i) / count), 0];
  for (let i = 0; i < count; i++) builder.capsule(at(i), at(i + 1), thickness);
  return builder.build();
}

// Balls at points on a string; the path of a wrist.
export function beads(points, radius) {
  const builder = new Builder();
  points.forEach((point, i) => {
    builder.capsule(point, point, i === points.length - 1 ? 1.6 * radius : radius);
    if (i) builder.capsule(points[i - 1], point, 0.35 * radius);
  });
  return builder.build();
}

// A round table top at height zero with lines that show its scale: rings of 5 cm.
export function table(radius) {
  const builder = new Builder();
  const colours = [];
  const ring = 0.05;
  for (let inner = 0; inner < radius - 1e-9; inner += ring) {
    const line = 0.0006;
    const parts = [[inner, inner + ring - line, [1, 1, 1]], [inner + ring - line, inner + ring, [0.913, 0.913, 0.911]]];
    for (const [from, to, colour] of parts) {
      const before = builder.positions.length;
      const fine = 48;
      for (let k = 0; k <= fine; k++) {
        const angle = (2 * Math.PI * k) / fine;
        for (const r of [from, to]) builder.positions.push(r * Math.cos(angle), r * Math.sin(angle), 0);
      }
      const first = before / 3;
      for (let k = 0; k < fine; k++) builder.indices.push(first + 2 * k, first + 2 * k + 1, first + 2 * k + 2, first + 2 * k + 1, first + 2 * k + 3, first + 2 * k + 2);
      for (let i = before; i < builder.positions.length; i += 3) {
        builder.normals.push(0, 0, 1);
        colours.push(...colour);
      }
    }
  }
  return { ...builder.build(), colours: new Float32Array(colours) };
}

// An object's mesh, smooth where neighbouring faces turn by less than 35 degrees. Corners at one vertex share a point of the
// result where their normals agree; `vertex` says which vertex each point is at.
export function smooth(vertices, faces) {
  const count = faces.length / 3;
  const at = (i) => [vertices[3 * i], vertices[3 * i + 1], vertices[3 * i + 2]];
  const flat = [];
  const around = new Map();
  for (let f = 0; f < count; f++) {
    const [a, b, c] = [at(faces[3 * f]), at(faces[3 * f + 1]), at(faces[3 * f + 2])];
    flat.push(cross(sub(b, a), sub(c, a)));
    for (let k = 0; k < 3; k++) {
      const vertex = faces[3 * f + k];
      if (!around.has(vertex)) around.set(vertex, []);
      around.get(vertex).push(f);
    }
  }
  const turned = flat.map(unit);
  const crease = Math.cos((35 * Math.PI) / 180);
  const made = new Map(); // points by vertex: [normal, index] of each
  const positions = [];
  const normals = [];
  const vertex = [];
  const indices = new Uint32Array(3 * count);
  for (let f = 0; f < count; f++)
    for (let k = 0; k < 3; k++) {
      const v = faces[3 * f + k];
      let sum = [0, 0, 0];
      for (const g of around.get(v)) {
        const cosine = turned[f][0] * turned[g][0] + turned[f][1] * turned[g][1] + turned[f][2] * turned[g][2];
        if (cosine > crease) sum = add(sum, flat[g]);
      }
      const normal = unit(sum);
      if (!made.has(v)) made.set(v, []);
      let point = made.get(v).find(([other]) => other[0] * normal[0] + other[1] * normal[1] + other[2] * normal[2] > ALIKE);
      if (!point) {
        point = [normal, vertex.length];
        made.get(v).push(point);
        vertex.push(v);
        positions.push(...at(v));
        normals.push(...normal);
      }
      indices[3 * f + k] = point[1];
    }
  return { positions: new Float32Array(positions), normals: new Float32Array(normals), colours: white(positions.length), indices, vertex };
}
