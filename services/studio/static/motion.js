// A recorded motion; frames between two steps are interpolated.

import { Quaternion, Vector3 } from "./vendor/three.module.min.js";

// Points of rows x y z, or of all their numbers in one row.
function points(rows) {
  const numbers = Array.from(rows).flat();
  return Array.from({ length: numbers.length / 3 }, (_, i) => new Vector3().fromArray(numbers, 3 * i));
}

// Poses of positions x y z and quaternions w x y z, in either form.
export function poses({ position, quaternion }) {
  const q = Array.from(quaternion).flat();
  return points(position).map((place, i) => ({
    position: place, quaternion: new Quaternion(q[4 * i + 1], q[4 * i + 2], q[4 * i + 3], q[4 * i]),
  }));
}

// A constraint's marker as the server describes it; a ghost has poses of links.
export function marker({ kind, tip, direction, points: line, position, quaternion }) {
  return {
    kind, tip: tip && points(tip)[0], direction: direction && points(direction)[0], points: line && points(line),
    links: position && poses({ position, quaternion }),
  };
}

function between(before, after, share) {
  return { position: before.position.clone().lerp(after.position, share), quaternion: before.quaternion.clone().slerp(after.quaternion, share) };
}

// The numbers of each step, from a list of all steps.
function steps(list, count) {
  const width = list.length / count;
  return Array.from({ length: count }, (_, t) => list.slice(t * width, (t + 1) * width));
}

export class Motion {
  constructor(id, { arrays, meta }) {
    const data = (name) => arrays[name].data;
    this.id = id;
    this.meta = meta;
    this.hand = meta.hand;
    this.dt = meta.control_dt;
    this.vertices = data("visual_vertices");
    this.faces = data("visual_faces");
    this.colours = arrays.visual_colours?.data;
    this.table = data("table");
    this.steps = this.table.length;
    this.links = steps(poses({ position: data("link_position"), quaternion: data("link_quaternion") }), this.steps);
    this.objects = poses({ position: data("object_position"), quaternion: data("object_quaternion") });
    this.forces = steps(points(data("contact_force")), this.steps);
    this.center = this.objects[0].position;
    this.markers = this.#markers(arrays);
    this.avoid = this.markers.some(({ kind }) => kind === "paint") ? this.#labels(arrays) : null;
    this.rewards = {};
    for (const [name, { data }] of Object.entries(arrays)) if (name.startsWith("reward/")) this.rewards[name.slice(7)] = data;
    this.lanes = Object.entries(meta.lanes).map(([name, legend]) => {
      const errors = {};
      for (const key of Object.keys(arrays)) {
        const [, lane, unit] = key.match(/^lane\/([^/]+)\/(.+)$/) ?? [];
        if (lane === name && unit !== "met" && unit !== "counts") errors[unit] = data(key);
      }
      return { name, legend, errors, met: data(`lane/${name}/met`), counts: data(`lane/${name}/counts`) };
    });
    this.totalForce = this.forces.map((links) => links.reduce((sum, force) => sum + force.length(), 0));
    this.totalReward = this.forces.map((_, t) => Object.values(this.rewards).reduce((sum, term) => sum + term[t], 0));
  }

  get duration() {
    return (this.steps - 1) * this.dt;
  }

  // Markers of the constraints: their arrays are named KIND/CONSTRAINT/FIELD.
  #markers(arrays) {
    const found = {};
    for (const [name, { data }] of Object.entries(arrays)) {
      const [kind, constraint, field] = name.split("/");
      if (["arrow", "polyline", "ghost", "paint"].includes(kind)) (found[`${kind}/${constraint}`] ??= { kind })[field] = data;
    }
    return Object.values(found).map(marker);
  }

  // Each vertex has the label of the surface point nearest to it.
  #labels(arrays) {
    const surface = points(arrays.surface_points.data);
    const { data: avoid } = arrays.surface_avoid;
    return points(this.vertices).map((vertex) => {
      let [nearest, label] = [Infinity, 0];
      surface.forEach((point, i) => {
        const far = point.distanceToSquared(vertex);
        if (far < nearest) [nearest, label] = [far, avoid[i]];
      });
      return label;
    });
  }

  step(time) {
    return Math.min(this.steps - 1, Math.max(0, Math.round(time / this.dt)));
  }

  at(time) {
    const exact = Math.min(Math.max(time / this.dt, 0), this.steps - 1);
    const before = Math.floor(exact);
    const after = Math.min(before + 1, this.steps - 1);
    return {
      links: this.links[before].map((link, i) => between(link, this.links[after][i], exact - before)),
      object: between(this.objects[before], this.objects[after], exact - before),
      forces: this.forces[this.step(time)],
      table: this.table[before] > 0,
    };
  }
}
