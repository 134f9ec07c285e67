// Content of the picture: hand, object, constraints and contacts.

import {
  Color, CylinderGeometry, DirectionalLight, DoubleSide, EqualStencilFunc, Group, HemisphereLight, IncrementStencilOp,
  LatheGeometry, LessDepth, LessEqualDepth, Mesh, MeshBasicMaterial, MeshLambertMaterial, ReplaceStencilOp, RingGeometry,
  Scene, SphereGeometry, TorusGeometry, Vector2, Vector3,
} from "./vendor/three.module.min.js";
import { AVOID, Body } from "./body.js";
import { Hand } from "./hand.js";
import { marker, poses } from "./motion.js";
import { colour } from "./theme.js";

const HEADING = new Color(0.22, 0.4, 0.86);
const HOVERED = new Color(1, 0.8, 0.2);
const COUNTS = new Color(0.1, 0.62, 0.85);
const PATH = new Color(0.53, 0.3, 0.75);
const FORCE = new Color(0.98, 0.8, 0.12);

export const ARROW = 0.1; // length of the approach arrow, m
const FULL = 2; // N at which a link has most of its colour
const LEAST = 0.05; // N from which a force is drawn
const FORCE_LENGTH = 0.015; // m per newton
const LONGEST = 0.09; // m
const TABLE = 0.3; // m
const RING = 0.05; // m between two lines of the table
const LINE = 0.0006; // m
const KEY = new Vector3(0.35, -0.5, 0.8); // towards the light that casts shadows
const SHADE = 0.2; // of a shadow
const OVERRULED = 0.45; // opacities
const GHOST = 0.4;
const BEHIND = 0.4; // opacity of a motion behind another

const FORWARD = new Vector3(0, 0, 1); // of the shapes below, which have the length 1
const SHAFT = arrow(0.0028, 0.168);
const PUSH = arrow(0.0027, 0.18);
const ROD = new CylinderGeometry(0.0012, 0.0012, 1, 12).translate(0, 0.5, 0).rotateX(Math.PI / 2);
const BEAD = new SphereGeometry(0.0035, 20, 12);
const BALL = new SphereGeometry(0.006, 20, 12);

// An arrow whose head is a share of its length.
function arrow(radius, head) {
  const sharp = [[radius, 0], [radius, 1 - head], [2.5 * radius, 1 - head]].flatMap((point) => [point, point]);
  return new LatheGeometry([[0, 0], ...sharp, [0, 1]].map((point) => new Vector2(...point)), 20).rotateX(Math.PI / 2);
}

function fade(material, opacity) {
  return Object.assign(material, { opacity, transparent: opacity < 1, depthWrite: opacity === 1, needsUpdate: true });
}

function lit(color, opacity = 1) {
  return fade(new MeshLambertMaterial({ color }), opacity);
}

// Of shadows, which darken each place of the table once.
function shade() {
  const once = { stencilWrite: true, stencilRef: 1, stencilFunc: EqualStencilFunc, stencilZPass: IncrementStencilOp };
  return new MeshBasicMaterial({ color: 0, opacity: SHADE, transparent: true, depthWrite: false, side: DoubleSide, forceSinglePass: true, ...once });
}

// Lays a shape onto a line from a point.
function along(part, start, direction, length) {
  part.position.copy(start);
  part.quaternion.setFromUnitVectors(FORWARD, direction);
  part.scale.z = length;
  return part;
}

function approach(part, tip, direction) {
  return along(part, tip.clone().addScaledVector(direction, -ARROW), direction, ARROW);
}

// Shapes of the constraints' markers, in the object frame, by kind; paint is part of the body.
const MARKERS = {
  arrow: ({ tip, direction }, skin, opacity) => approach(new Mesh(SHAFT, lit(HEADING, opacity)), tip, direction),
  polyline: ({ points }, skin, opacity) => {
    const [string, material] = [new Group(), lit(PATH, opacity)];
    points.forEach((point, i) => {
      const bead = new Mesh(BEAD, material);
      bead.position.copy(point);
      if (i === points.length - 1) bead.scale.setScalar(1.6);
      string.add(bead);
      const step = points[i - 1]?.clone().sub(point);
      if (step) string.add(along(new Mesh(ROD, material), point, step.clone().normalize(), step.length()));
    });
    return string;
  },
  ghost: ({ links }, skin) => {
    const hidden = { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 8 }; // where the hand has its pose
    const hand = new Hand(skin, Object.assign(lit(HEADING, GHOST), hidden));
    hand.follow(links);
    return hand;
  },
};

function marked(markers, skin, opacity) {
  const group = new Group();
  for (const marker of markers) if (marker.kind in MARKERS) group.add(MARKERS[marker.kind](marker, skin, opacity));
  return group;
}

// Frees what a part of the scene holds on the graphics card.
function release(part) {
  part?.removeFromParent();
  part?.traverse(({ geometry, material, skeleton }) => [geometry, material, skeleton].forEach((held) => held?.dispose()));
}

// A round table top at height zero with lines that show its scale.
class Table extends Group {
  constructor() {
    super();
    const ground = { stencilWrite: true, stencilRef: 1, stencilZPass: ReplaceStencilOp };
    this.top = new MeshBasicMaterial(ground);
    this.line = new MeshBasicMaterial(ground);
    for (let outer = RING; outer < TABLE + 1e-9; outer += RING) {
      const inner = outer - LINE;
      this.add(new Mesh(new RingGeometry(outer - RING, inner, 96), this.top), new Mesh(new RingGeometry(inner, outer, 96), this.line));
    }
  }

  at({ x, y }) {
    this.position.set(x, y, 0);
  }

  recolour() {
    this.top.color.set(colour("--table"));
    this.line.color.copy(this.top.color).multiplyScalar(0.913);
  }
}

// A hand and an object on the table.
class Pair extends Group {
  constructor() {
    super();
    this.table = new Table();
    this.object = new Group(); // its children are in the object frame
    this.shadow = new Group();
    this.shadow.matrixAutoUpdate = false;
    this.shadow.matrix.set(1, 0, -KEY.x / KEY.z, 0, 0, 1, -KEY.y / KEY.z, 0, 0, 0, 0, 0.0004, 0, 0, 0, 1); // onto the table
    this.add(this.table, this.object, this.shadow);
  }

  setBody(body) {
    release(this.body);
    release(this.bodyShadow);
    this.body = body;
    this.bodyShadow = new Mesh(body.geometry, shade());
    this.object.add(body);
    this.shadow.add(this.bodyShadow);
  }

  setSkin(skin) {
    release(this.hand);
    release(this.handShadow);
    this.skin = skin;
    this.hand = new Hand(skin, new MeshLambertMaterial({ vertexColors: true }));
    this.handShadow = this.hand.shadow(shade());
    this.add(this.hand);
    this.shadow.add(this.handShadow);
  }

  mark(markers, opacity) {
    release(this.marks);
    this.marks = marked(markers, this.skin, opacity);
    this.object.add(this.marks);
  }

  place({ position, quaternion }) {
    for (const part of [this.object, this.bodyShadow]) {
      part.position.copy(position);
      part.quaternion.copy(quaternion);
    }
  }
}

// The constraints while they are edited.
export class Editing extends Pair {
  constructor() {
    super();
    this.arrow = new Mesh(SHAFT, lit(HEADING, OVERRULED));
    this.counts = new Mesh(SHAFT, lit(COUNTS));
    this.balls = { tip: new Mesh(BALL, lit(HEADING)), tail: new Mesh(BALL, lit(HEADING)) };
    this.ring = new Mesh(new TorusGeometry(1, 0.025, 8, 48), new MeshBasicMaterial({ depthTest: false, transparent: true }));
    this.ring.renderOrder = 1;
    this.object.add(this.arrow, this.counts, ...Object.values(this.balls), this.ring);
  }

  // Shows the studio's state.
  take({ rest, start, active, markers }) {
    this.place(poses(rest)[0]);
    this.table.at(this.object.position);
    this.hand.follow(poses(start));
    this.mark(markers.map(marker), 1);
    // An overridden arrow is faint; the active one is drawn as well.
    this.counts.visible = active.overruled;
    fade(this.arrow.material, active.overruled ? OVERRULED : 1);
    approach(this.counts, new Vector3(...active.position), new Vector3(...active.direction));
    this.updateMatrixWorld(true);
  }

  // Shows the arrow, a ray of the object frame to its tip, with its ends by name, of which one is hovered; and the brush
  // {point, normal, radius, avoid} over the object, or null.
  frame({ origin, direction }, ends, hovered, brush) {
    approach(this.arrow, origin, direction);
    for (const [name, ball] of Object.entries(this.balls)) {
      ball.position.copy(ends[name]);
      ball.material.color.copy(name === hovered ? HOVERED : HEADING);
    }
    this.ring.visible = Boolean(brush);
    if (!brush) return;
    along(this.ring, brush.point, brush.normal, 1).scale.setScalar(brush.radius);
    this.ring.material.color.set(brush.avoid ? AVOID : colour("--ink"));
  }
}

// A motion, at one of its frames.
export class Playing extends Pair {
  constructor(motion, skin) {
    super();
    this.motion = motion;
    this.setBody(new Body(motion.vertices, motion.faces, motion.colours));
    this.body.paint(motion.avoid);
    this.setSkin(skin);
    this.table.at(motion.center);
    this.mark(motion.markers, 0.85);
    this.pushes = motion.forces[0].map(() => new Mesh(PUSH, lit(FORCE)));
    this.add(...this.pushes);
    this.behind = false;
  }

  // Makes it faint behind another motion.
  set behind(on) {
    this.faint = on;
    this.traverse(({ material }) => {
      if (!material) return;
      material.userData.opacity ??= material.opacity;
      fade(material, material.userData.opacity * (on ? BEHIND : 1)).depthFunc = on ? LessDepth : LessEqualDepth;
    });
  }

  seek(time) {
    const { links, object, forces, table } = this.motion.at(time);
    this.table.visible = table && !this.faint;
    this.place(object);
    this.hand.follow(links);
    if (forces === this.forces) return this.#push(links);
    this.forces = forces;
    const strengths = forces.map((force) => force.length());
    this.hand.touch(strengths.map((strength) => (strength > LEAST ? 0.3 + 0.3 * Math.min(strength / FULL, 1) : 0)));
    this.#push(links);
  }

  #push(links) {
    this.forces.forEach((force, i) => {
      const strength = force.length();
      this.pushes[i].visible = strength > LEAST;
      if (strength > LEAST) along(this.pushes[i], links[i].position, force.clone().divideScalar(strength), Math.min(FORCE_LENGTH * strength, LONGEST));
    });
  }

  release() {
    release(this);
  }
}

// The whole scene and its light.
export class Stage extends Scene {
  constructor() {
    super();
    const key = new DirectionalLight(0xffffff, 0.4 * Math.PI);
    key.position.copy(KEY);
    const second = new DirectionalLight(0xffffff, 0.12 * Math.PI);
    second.position.set(-0.7, 0.5, 0.25);
    const sky = new HemisphereLight(new Color(0.66, 0.66, 0.66), new Color(0.34, 0.34, 0.34), Math.PI);
    sky.position.copy(FORWARD);
    this.background = new Color();
    this.add(key, second, sky);
  }

  // Shows only the given groups.
  show(groups, shadows) {
    this.background.set(colour("--stage"));
    for (const child of this.children) if (child instanceof Pair) child.visible = groups.includes(child);
    for (const group of groups) {
      group.table.recolour();
      group.shadow.visible = shadows && group.table.visible;
    }
  }
}
