// An object's mesh for drawing, painting and picking.

import { BufferAttribute, BufferGeometry, Color, DoubleSide, Mesh, MeshLambertMaterial, Raycaster, Sphere, Vector3 } from "./vendor/three.module.min.js";

const OBJECT = new Color(0.95, 0.64, 0.28);
export const AVOID = new Color(0.8, 0.22, 0.22);
const HINT = 0.55; // share of a brush's colour in its preview
const CREASE = Math.cos((35 * Math.PI) / 180);
const ALIKE = 0.9999; // cosine between normals that count as one

// A mesh, smooth where neighbouring faces turn by less than 35 degrees. Corners at one vertex share a point of the result
// where their normals agree; `vertex` lists the vertex of each point.
function creased(corners, faces) {
  const flat = []; // normals of the faces, as long as twice their areas
  const around = corners.map(() => []); // faces by vertex
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => corners[faces[f + k]]);
    flat.push(b.clone().sub(a).cross(c.clone().sub(a)));
    for (let k = 0; k < 3; k++) around[faces[f + k]].push(flat.length - 1);
  }
  const turned = flat.map((normal) => normal.clone().normalize());
  const points = corners.map(() => []); // [normal, index] of each point, by vertex
  const vertex = [];
  const normals = [];
  const indices = new Uint32Array(faces.length);
  faces.forEach((v, i) => {
    const own = turned[Math.floor(i / 3)];
    const normal = new Vector3();
    for (const f of around[v]) if (own.dot(turned[f]) > CREASE) normal.add(flat[f]);
    normal.normalize();
    let point = points[v].find(([other]) => other.dot(normal) > ALIKE);
    if (!point) {
      points[v].push((point = [normal, vertex.length]));
      vertex.push(v);
      normals.push(normal);
    }
    indices[i] = point[1];
  });
  const geometry = new BufferGeometry().setFromPoints(vertex.map((v) => corners[v])).setIndex(new BufferAttribute(indices, 1));
  geometry.setAttribute("normal", new BufferAttribute(new Float32Array(normals.flatMap((normal) => normal.toArray())), 3));
  return { geometry, vertex };
}

export class Body extends Mesh {
  // `own` are three bytes of colour for each vertex, if the object has any.
  constructor(vertices, faces, own = null) {
    const corners = Array.from({ length: vertices.length / 3 }, (_, v) => new Vector3().fromArray(vertices, 3 * v));
    const { geometry, vertex } = creased(corners, faces);
    super(geometry, new MeshLambertMaterial({ vertexColors: true, side: DoubleSide }));
    this.radius = new Sphere().setFromPoints(corners, new Vector3()).radius;
    this.vertex = vertex;
    this.points = vertex.map((v) => corners[v]);
    this.bare = vertex.map((v) => (own ? new Color().fromArray(own, 3 * v).multiplyScalar(1 / 255) : OBJECT)); // without paint
    geometry.setAttribute("color", new BufferAttribute(new Float32Array(3 * vertex.length), 3));
    this.raycaster = new Raycaster();
    this.paint(null);
  }

  // Colours by a label for each vertex; all alike without labels.
  paint(avoid) {
    this.colours = this.vertex.map((v, i) => (avoid?.[v] ? AVOID : this.bare[i]));
    this.#show(this.colours);
  }

  // Shows what a brush at a point of the object frame would paint; nothing without a point.
  preview(point, radius, avoid) {
    if (!point && !this.previewed) return;
    this.previewed = Boolean(point);
    const hinted = (colour, target) => colour.clone().lerp(target, HINT);
    this.#show(point ? this.#brushed(point, radius, avoid, hinted) : this.colours);
  }

  // Colours the surface under a brush at a point of the object frame, until the server responds.
  brush(point, radius, avoid) {
    this.colours = this.#brushed(point, radius, avoid, (_, target) => target);
    this.#show(this.colours);
  }

  #brushed(point, radius, avoid, mixed) {
    return this.colours.map((colour, i) => (this.points[i].distanceTo(point) <= radius ? mixed(colour, avoid ? AVOID : this.bare[i]) : colour));
  }

  #show(colours) {
    const { color } = this.geometry.attributes;
    colours.forEach((colour, i) => colour.toArray(color.array, 3 * i));
    color.needsUpdate = true;
  }

  // Where a ray of the world meets the surface first: {point, normal, distance} in the object frame, or null.
  hit(ray) {
    this.raycaster.ray.copy(ray);
    const [first] = this.raycaster.intersectObject(this, false);
    if (!first) return null;
    const { normal } = first.face;
    const outward = normal.clone().transformDirection(this.matrixWorld).dot(ray.direction) < 0;
    return { point: this.worldToLocal(first.point), normal: outward ? normal : normal.negate(), distance: first.distance };
  }
}
