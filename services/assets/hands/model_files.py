"""A hand from a URDF or MJCF file: what it says is taken over, and what it does not say is proposed.

MuJoCo reads the file. The palm is the first body that fingers branch off; what stands before it (an arm, a wrist) is
left out, since the wrist is a virtual mount here. Bodies without a hinge belong to the link that carries them. Links
become capsules, and the pose in which the fingers close follows from the ranges of their joints.
"""

import dataclasses
import pathlib
import re

import mujoco
import numpy as np
import trimesh

from common.errors import CongraspError
from common.hands.files import faults, hand_from_text, hand_text
from common.hands.kinematics import grasp_frame
from common.hands.measures import fitting_scale
from common.hands.spec import Capsule, Hand, Joint, Link, chain_of, vector, wrist_gains
from services.assets.hands.compile import compiled_model
from services.assets.hands.poses import opening, propose_poses, thumb_of

TORQUE = 1.0
"""N.m, of a joint for which the file names no limit."""
_REACH = 0.3  # rad of error at which a joint gives all its torque, where the file has no gain
_FLAT = 1.6  # broader than this, a link gets several capsules side by side


@dataclasses.dataclass(frozen=True)
class Proposal:
    """A hand as it was understood, and what was not in the file."""

    hand: Hand
    notes: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Choices:
    """What a user knows better than the file."""

    name: str = ""
    palm: str = ""
    thumb: str = ""
    object_scale: float = 0.0


_GUESSED = Choices()


def import_hand(path: pathlib.Path, choices: Choices = _GUESSED) -> Proposal:
    """The hand of a file.

    Args:
      path: URDF (.urdf) or MJCF (.xml); meshes lie where it says, as MuJoCo finds them.
      choices: name, palm's body, thumb's last body and object scale, where they are not to be guessed.

    Raises:
      CongraspError: the file cannot be read, or what it shows is no hand of hinges with at least two fingers.
    """
    notes: list[str] = []
    model = compiled_model(path, notes)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    palm = _palm(model, choices.palm)
    bodies = _bodies(model, palm)
    links = _links(model, data, palm, bodies, notes)
    notes += _remarks(model, palm, bodies)
    tips = [link.name for link in links if link.tip is not None]
    if len(tips) < 2:
        raise CongraspError(
            f"{path} has {len(tips)} finger(s) on its palm '{_name(model, palm)}'.", "Name another --palm."
        )
    name = re.sub(r"\W+", "_", choices.name or path.stem).strip("_").lower() or "hand"
    hand = Hand(
        name=name,
        links=tuple(links),
        thumb=thumb_of(links, tips, choices.thumb),
        open_pose={},
        closed_pose={},
        wrist=wrist_gains(sum(link.mass for link in links)),
    )
    hand = propose_poses(hand)
    scale = choices.object_scale or fitting_scale(opening(hand))
    hand = dataclasses.replace(hand, object_scale=scale)
    for fault in faults(hand):
        raise CongraspError(f"{path}: {fault}.", "Correct the file, or write a hand file by hand (docs/add-a-hand.md).")
    return Proposal(hand_from_text(hand_text(hand), str(path)), tuple(notes))


def describe(proposal: Proposal) -> list[str]:
    """What was understood and what was proposed, as lines of text."""
    hand = proposal.hand
    frame = grasp_frame(hand)
    tips = [chain_of(hand, hand.links[i].name) for i in hand.tip_links]
    mass = sum(link.mass for link in hand.links)
    lines = [
        f"hand         {hand.name}: {len(hand.joints)} joints, {len(hand.links)} links, {mass:.3f} kg",
        f"thumb        {' - '.join(tips[0])}",
        *(f"finger       {' - '.join(tip)}" for tip in tips[1:]),
        f"heading v    {_text(frame.heading)} in the palm's frame, cross-finger axis w {_text(frame.cross)}",
        f"hand centre  {_text(frame.center)} m, opening {100 * frame.opening:.1f} cm: objects x {hand.object_scale:g}",
        "",
        "joint                     from      to    open  closed      kp      kv   limit",
    ]
    for joint, opened, closed in zip(hand.joints, hand.q_open, hand.q_closed, strict=True):
        figures = (joint.lower, joint.upper, opened, closed, joint.kp, joint.kv, joint.torque_limit)
        lines.append(f"{joint.name:22s}" + "".join(f"{x:8.3f}" for x in figures))
    return [*lines, "rad, N.m/rad, N.m.s/rad, N.m", *(f"note: {note}" for note in proposal.notes)]


def _text(vector: np.ndarray) -> str:
    """A vector (3,) with three digits."""
    return "(" + ", ".join(f"{x:.3f}" for x in vector) + ")"


def _name(model: mujoco.MjModel, body: int) -> str:
    """A body's name as an identifier."""
    return re.sub(r"\W+", "_", model.body(body).name) or f"body_{body}"


def _joint_name(model: mujoco.MjModel, j: int) -> str:
    """A joint's name as an identifier."""
    return re.sub(r"\W+", "_", model.joint(j).name) or f"joint_{j}"


def _hinges(model: mujoco.MjModel, body: int) -> list[int]:
    """Indices of a body's joints."""
    start, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    return list(range(start, start + count))


def _palm(model: mujoco.MjModel, wanted: str) -> int:
    """The first body, from the root, off which at least two bodies with hinges branch."""
    names = [model.body(i).name for i in range(model.nbody)]
    if wanted:
        if wanted not in names:
            raise CongraspError(f"There is no body '{wanted}'.", f"Name one of: {', '.join(filter(None, names))}.")
        return names.index(wanted)
    moves = np.array(model.body_jntnum) > 0
    for body in range(model.nbody - 1, 0, -1):
        moves[model.body_parentid[body]] |= moves[body]
    palm = 0
    while True:
        below = [b for b in range(1, model.nbody) if model.body_parentid[b] == palm and moves[b]]
        if len(below) != 1:
            return palm
        palm = below[0]


def _bodies(model: mujoco.MjModel, palm: int) -> dict[int, list[int]]:
    """Bodies that make up each link, by the body that moves it; those without a hinge belong to what carries them."""
    owner = {palm: palm}
    groups = {palm: [palm]}
    for body in range(palm + 1, model.nbody):
        parent = int(model.body_parentid[body])
        if parent not in owner:
            continue
        owner[body] = body if model.body_jntnum[body] else owner[parent]
        groups.setdefault(owner[body], []).append(body)
    return groups


def _links(
    model: mujoco.MjModel, data: mujoco.MjData, palm: int, groups: dict[int, list[int]], notes: list[str]
) -> list[Link]:
    """The links, in the palm's frame at zero, from the bodies of each (`_bodies`); `notes` says what is proposed."""
    turn, origin = data.xmat[palm].reshape(3, 3), data.xpos[palm]
    owner = {body: moved for moved, group in groups.items() for body in group}
    names = {moved: "palm" if moved == palm else _name(model, moved) for moved in groups}
    carriers = {owner[int(model.body_parentid[moved])] for moved in groups if moved != palm}
    links = []
    bare = []
    for moved, group in groups.items():
        joints = () if moved == palm else tuple(_joint(model, data, j, turn, origin) for j in _hinges(model, moved))
        at = np.array(joints[0].anchor) if joints else np.zeros(3)
        points = [(p - origin) @ turn for body in group for p in _surface(model, data, body)]
        ends = [
            (data.xanchor[_hinges(model, m)[0]] - origin) @ turn
            for m in groups
            if m != palm and owner[int(model.body_parentid[m])] == moved
        ]
        if not points:
            bare.append(names[moved])
            points = [at + d for end in (ends or [at]) for d in _ball(0.005, at, end)]
        capsules = _capsules(np.array(points))
        mass = float(sum(model.body_mass[body] for body in group))
        tip = None
        if moved != palm and moved not in carriers:
            tip = max((c for x in capsules for c in (x.start, x.end)), key=lambda c: float(np.linalg.norm(c - at)))
        links.append(
            Link(
                name=names[moved],
                parent="" if moved == palm else names[owner[int(model.body_parentid[moved])]],
                joints=joints,
                capsules=capsules,
                mass=max(mass, 1e-3),
                contact_weight=3.0 if tip is not None else 1.0,
                tip=tip,
            )
        )
        if mass <= 0:
            notes.append(f"'{names[moved]}' has no mass: 1 g")
    if bare:
        notes.append(f"no geometry: {', '.join(bare)}")
    return links


def _remarks(model: mujoco.MjModel, palm: int, groups: dict[int, list[int]]) -> list[str]:
    """What the file does not say of its joints, and what of it is left out."""
    found = []
    hinges = [j for moved in groups if moved != palm for j in _hinges(model, moved)]
    if limitless := [_joint_name(model, j) for j in hinges if not _motor(model, j)[1]]:
        found.append(f"no torque limit, {TORQUE:g} N.m is proposed: {', '.join(limitless)}")
    if model.neq:
        found.append(f"{model.neq} couplings between joints are left out: every joint has its own motor here")
    return found


def _joint(model: mujoco.MjModel, data: mujoco.MjData, j: int, turn: np.ndarray, origin: np.ndarray) -> Joint:
    """A hinge in the palm's frame, which `turn` (3, 3) brings to the world and whose origin lies at `origin` (3,) m.

    Without a gain of the file kp gives all the torque at `_REACH`, and kv is 1.4 sqrt(kp I) with the joint's inertia I.
    """
    name = _joint_name(model, j)
    if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE:
        raise CongraspError(f"The joint '{name}' is not a hinge.", "Hands of hinges alone can be imported.")
    lower, upper = model.jnt_range[j] - model.qpos0[model.jnt_qposadr[j]]
    if not model.jnt_limited[j]:
        raise CongraspError(f"The joint '{name}' has no limits.", "Give it a range.")
    dof = model.jnt_dofadr[j]
    kp, limit = _motor(model, j)
    limit = limit or TORQUE
    kp = kp or limit / _REACH
    armature = float(model.dof_armature[dof]) or 5e-4
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    kv = 1.4 * np.sqrt(kp * max(float(inertia[dof, dof]) - model.dof_armature[dof] + armature, armature))
    return Joint(
        name,
        vector(turn.T @ data.xaxis[j]),
        vector((data.xanchor[j] - origin) @ turn),
        round(float(lower), 6),
        round(float(upper), 6),
        kp=round(float(kp), 4),
        kv=round(float(kv), 4),
        torque_limit=round(float(limit), 4),
        damping=round(float(model.dof_damping[dof]), 6),
        armature=armature,
    )


def _motor(model: mujoco.MjModel, j: int) -> tuple[float, float]:
    """Gain of the joint's position actuator and its torque limit, zero where the file has none."""
    kp = limit = 0.0
    if model.jnt_actfrclimited[j]:
        limit = float(np.abs(model.jnt_actfrcrange[j]).max())
    for a in range(model.nu):
        if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[a, 0] == j:
            kp = max(0.0, -float(model.actuator_biasprm[a, 1]))
            if model.actuator_forcelimited[a] and not limit:
                limit = float(np.abs(model.actuator_forcerange[a]).max())
    return kp, limit


def _surface(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> list[np.ndarray]:
    """World points on what collides of a body, or on what is drawn of it if nothing collides."""
    mine = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body]
    solid = [g for g in mine if model.geom_contype[g] | model.geom_conaffinity[g]] or mine
    found = []
    for g in solid:
        kind, size = mujoco.mjtGeom(model.geom_type[g]), model.geom_size[g]
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            m = model.geom_dataid[g]
            start = model.mesh_vertadr[m]
            local = model.mesh_vert[start : start + model.mesh_vertnum[m]]
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            local = np.array(trimesh.creation.box(2 * size).vertices)
        elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            local = np.array(trimesh.creation.icosphere(1, size[0]).vertices)
        elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            local = np.array(trimesh.creation.capsule(2 * size[1], size[0], count=(8, 8)).vertices)
        elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
            local = np.array(trimesh.creation.cylinder(size[0], 2 * size[1], sections=12).vertices)
        elif kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            local = np.array(trimesh.creation.icosphere(1).vertices) * size
        else:
            continue
        found += list(local @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g])
    return found


def _ball(radius: float, *centers: np.ndarray) -> list[np.ndarray]:
    """Points around the centres, relative to the first."""
    return [c - centers[0] + radius * d for c in centers for d in np.concatenate([np.eye(3), -np.eye(3)])]


def _capsules(points: np.ndarray) -> tuple[Capsule, ...]:
    """Capsules along the longest side of the points' box; several side by side where it is flat."""
    to_box, extents = trimesh.bounds.oriented_bounds(points)
    order = np.argsort(extents)[::-1]
    length, breadth, height = np.maximum(extents[order], 1e-3)
    center, axes = np.linalg.inv(to_box)[:3, 3], np.linalg.inv(to_box)[:3, order]
    flat = breadth > _FLAT * height
    radius = height / 2 if flat else (breadth + height) / 4
    count = min(5, int(np.ceil(breadth / height))) if flat else 1
    half = max(length / 2 - radius, 1e-3)
    across = np.linspace(-1, 1, count) * (breadth / 2 - radius) if count > 1 else np.zeros(1)
    return tuple(
        Capsule(
            vector((center + x * axes[:, 1] - half * axes[:, 0]).round(6)),
            vector((center + x * axes[:, 1] + half * axes[:, 0]).round(6)),
            round(float(radius), 6),
        )
        for x in across
    )
