// A hand's surface, which follows its links by linear blend skinning.

import { Bone, BufferAttribute, BufferGeometry, Color, DetachedBindMode, Matrix4, Skeleton, SkinnedMesh, Uint16BufferAttribute, Vector3 } from "./vendor/three.module.min.js";

const INFLUENCES = 4;
const TOUCHING = new Color(0.13, 0.74, 0.63);

// The surface of a hand as the server sends it.
export class Skin {
  constructor({ arrays }) {
    const part = (name) => arrays[`skin_${name}`].data;
    this.geometry = new BufferGeometry().setIndex(new BufferAttribute(new Uint32Array(part("faces")), 1));
    for (const [name, array] of [["position", "points"], ["normal", "normals"], ["color", "colours"]])
      this.geometry.setAttribute(name, new BufferAttribute(part(array), 3));
    this.geometry.setAttribute("skinIndex", new Uint16BufferAttribute(part("joints"), INFLUENCES));
    this.geometry.setAttribute("skinWeight", new BufferAttribute(part("weights"), INFLUENCES));
    this.inverses = Array.from({ length: part("origins").length / 3 }, (_, i) =>
      new Matrix4().setPosition(new Vector3().fromArray(part("origins"), 3 * i).negate()));
  }
}

export class Hand extends SkinnedMesh {
  constructor({ geometry, inverses }, material) {
    super(material.vertexColors ? geometry.clone() : geometry, material); // colours of contacts are its own
    this.bones = inverses.map(() => new Bone());
    this.add(...this.bones);
    this.bind(new Skeleton(this.bones, inverses), new Matrix4());
    this.bare = geometry.attributes.color.array;
    this.frustumCulled = false;
  }

  // Moves the links to poses in the frame of the parent.
  follow(links) {
    links.forEach(({ position, quaternion }, i) => {
      this.bones[i].position.copy(position);
      this.bones[i].quaternion.copy(quaternion);
    });
  }

  // The same surface before a transformation of its parent is applied, such as that which makes it a shadow.
  shadow(material) {
    const shadow = new SkinnedMesh(this.geometry, material);
    shadow.bindMode = DetachedBindMode;
    shadow.bind(this.skeleton, new Matrix4());
    shadow.frustumCulled = false;
    return shadow;
  }

  // Mixes shares of a colour, one for each link, into the surface.
  touch(shares) {
    const { color, skinIndex, skinWeight } = this.geometry.attributes;
    for (let v = 0; v < color.count; v++) {
      let share = 0;
      for (let k = INFLUENCES * v; k < INFLUENCES * (v + 1); k++) share += skinWeight.array[k] * shares[skinIndex.array[k]];
      ["r", "g", "b"].forEach((name, k) => {
        const bare = this.bare[3 * v + k];
        color.array[3 * v + k] = bare + share * (TOUCHING[name] - bare);
      });
    }
    color.needsUpdate = true;
  }
}
