// A hand's surface, which follows its links by linear blend skinning.

import { pose } from "./math.js";

const INFLUENCES = 4;

export class Skin {
  constructor(renderer, { arrays, meta }) {
    this.renderer = renderer;
    this.links = meta.links.length;
    for (const name of ["points", "normals", "joints", "weights", "origins", "colours"]) this[name] = arrays[`skin_${name}`].data;
    this.indices = new Uint32Array(arrays.skin_faces.data);
    this.meshes = {}; // by use, because a hand and its reference pose are seen together
  }

  // A thing for the renderer: the surface with its links at `poses`, and with `shares[i]` of `tint` on each link.
  thing(use, poses, tint, shares) {
    const known = (this.meshes[use] ??= {
      mesh: this.renderer.mesh({ positions: this.points, normals: this.normals, colours: this.colours, indices: this.indices }),
      positions: new Float32Array(this.points.length),
      normals: new Float32Array(this.points.length),
      colours: new Float32Array(this.points.length),
    });
    const key = JSON.stringify([poses.position, poses.quaternion, shares]);
    if (known.key !== key) {
      known.key = key;
      this.#move(known, poses, tint, shares);
      this.renderer.move(known.mesh, known.positions, known.normals);
      this.renderer.recolour(known.mesh, known.colours);
    }
    return { mesh: known.mesh };
  }

  #move(known, poses, tint, shares) {
    const matrices = poses.position.map((place, i) => pose(place, poses.quaternion[i]));
    const { points, normals, joints, weights, origins, colours } = this;
    for (let v = 0; v < points.length / 3; v++) {
      const at = [0, 0, 0];
      const out = [0, 0, 0];
      let share = 0;
      for (let k = 0; k < INFLUENCES; k++) {
        const weight = weights[INFLUENCES * v + k];
        if (!weight) continue;
        const link = joints[INFLUENCES * v + k];
        const m = matrices[link];
        const x = points[3 * v] - origins[3 * link];
        const y = points[3 * v + 1] - origins[3 * link + 1];
        const z = points[3 * v + 2] - origins[3 * link + 2];
        for (let row = 0; row < 3; row++) {
          at[row] += weight * (m[row] * x + m[4 + row] * y + m[8 + row] * z + m[12 + row]);
          out[row] += weight * (m[row] * normals[3 * v] + m[4 + row] * normals[3 * v + 1] + m[8 + row] * normals[3 * v + 2]);
        }
        share += weight * shares[link];
      }
      known.positions.set(at, 3 * v);
      known.normals.set(out, 3 * v);
      for (let k = 0; k < 3; k++) known.colours[3 * v + k] = colours[3 * v + k] + share * (tint[k] - colours[3 * v + k]);
    }
  }
}
