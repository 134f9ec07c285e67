// A recorded motion: its frame at a time, between two steps too.

import { blend, mix, norm } from "./math.js";


function rows({ shape, data }) {
  const width = shape[shape.length - 1];
  const pick = (i) => Array.from(data.subarray(i * width, (i + 1) * width));
  if (shape.length === 2) return Array.from({ length: shape[0] }, (_, i) => pick(i));
  return Array.from({ length: shape[0] }, (_, t) => Array.from({ length: shape[1] }, (_, k) => pick(t * shape[1] + k)));
}

// Markers of one kind: their arrays are named KIND/CONSTRAINT/FIELD.
function markers(arrays, kind, make) {
  const found = {};
  for (const [name, array] of Object.entries(arrays)) {
    const [which, constraint, field] = name.split("/");
    if (which === kind) (found[constraint] ??= {})[field] = array;
  }
  return Object.values(found).map(make);
}

export class Motion {
  constructor(id, { arrays, meta }) {
    this.id = id;
    this.meta = meta;
    this.hand = meta.hand;
    this.dt = meta.control_dt;
    this.vertices = arrays.visual_vertices.data;
    this.faces = arrays.visual_faces.data;
    this.colours = arrays.visual_colours?.data;
    this.positions = rows(arrays.link_position);
    this.quaternions = rows(arrays.link_quaternion);
    this.objects = rows(arrays.object_position);
    this.turns = rows(arrays.object_quaternion);
    this.forces = rows(arrays.contact_force);
    this.table = arrays.table.data;
    this.steps = this.objects.length;
    this.center = this.objects[0];
    this.arrows = markers(arrays, "arrow", ({ tip, direction }) => ({ tip: Array.from(tip.data), direction: Array.from(direction.data) }));
    this.paths = markers(arrays, "polyline", ({ points }) => rows(points));
    this.ghosts = markers(arrays, "ghost", ({ position, quaternion }) => ({ position: rows(position), quaternion: rows(quaternion) }));
    this.avoid = markers(arrays, "paint", () => this.#labels(arrays))[0] ?? null;
    this.rewards = {};
    for (const [name, { data }] of Object.entries(arrays)) if (name.startsWith("reward/")) this.rewards[name.slice(7)] = data;
    this.lanes = Object.entries(meta.lanes).map(([name, legend]) => {
      const errors = {};
      for (const key of Object.keys(arrays)) {
        const [, lane, unit] = key.match(/^lane\/([^/]+)\/(.+)$/) ?? [];
        if (lane === name && unit !== "met" && unit !== "counts") errors[unit] = arrays[key].data;
      }
      return { name, legend, errors, met: arrays[`lane/${name}/met`].data, counts: arrays[`lane/${name}/counts`].data };
    });
    this.totalForce = this.forces.map((links) => links.reduce((sum, force) => sum + norm(force), 0));
    this.totalReward = this.forces.map((_, t) => Object.values(this.rewards).reduce((sum, term) => sum + term[t], 0));
  }

  get duration() {
    return (this.steps - 1) * this.dt;
  }

  // Each vertex has the label of the surface point nearest to it.
  #labels(arrays) {
    const { data: points } = arrays.surface_points;
    const { data: avoid } = arrays.surface_avoid;
    const labels = new Uint8Array(this.vertices.length / 3);
    for (let v = 0; v < labels.length; v++) {
      let nearest = Infinity;
      for (let p = 0; p < avoid.length; p++) {
        const x = points[3 * p] - this.vertices[3 * v];
        const y = points[3 * p + 1] - this.vertices[3 * v + 1];
        const z = points[3 * p + 2] - this.vertices[3 * v + 2];
        const far = x * x + y * y + z * z;
        if (far < nearest) [nearest, labels[v]] = [far, avoid[p]];
      }
    }
    return labels;
  }

  step(time) {
    return Math.min(this.steps - 1, Math.max(0, Math.round(time / this.dt)));
  }

  at(time) {
    const exact = Math.min(Math.max(time / this.dt, 0), this.steps - 1);
    const before = Math.min(Math.floor(exact), this.steps - 1);
    const after = Math.min(before + 1, this.steps - 1);
    const share = exact - before;
    const between = (list, how) => list[before].map((row, i) => how(row, list[after][i], share));
    return {
      step: this.step(time),
      links: { position: between(this.positions, mix), quaternion: between(this.quaternions, blend) },
      object: { position: mix(this.objects[before], this.objects[after], share), quaternion: blend(this.turns[before], this.turns[after], share) },
      forces: this.forces[this.step(time)],
      table: this.table[before] > 0,
    };
  }
}
