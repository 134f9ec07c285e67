"""Links of a hand in a model: its palm, the branches from it, and their geometry.

A body without a hinge belongs to its parent, so that a model is a tree of links. The palm is the
link with most branches; bodies before it (an arm, a wrist) are dropped, since the wrist is a
virtual mount. A link has capsules for its collision shapes, else for its visual shapes, else for
its inertia; and a visual mesh.
"""

import dataclasses
import re
from collections import Counter
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.hands.meshes import MAX_FACES
from congrasp.common.hands.spec import Capsule, Solid, vector
from congrasp.common.io.inputs import distinct_names
from congrasp.common.runtime.mujoco import mujoco
from congrasp.services.assets.hands.compile import LEAST, listed

_CALLED = ("palm", "hand")
_FREE = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
_KINDS: dict[mujoco.mjtGeom, Literal["box", "cylinder", "capsule", "ellipsoid"]] = {
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_SPHERE: "ellipsoid",
}
_FLAT = 1.6  # a broader link gets several parallel capsules
_PLAUSIBLE = (0.002, 0.15)  # half extent of an inertia's box, m
_THIN = 1e-4  # m, thickness below which points have no box of their own
_BARE = 0.005  # radius of a link without any geometry, m


@dataclasses.dataclass(frozen=True)
class Tree:
    """A hand's links in a model, each named by the body that moves it."""

    model: mujoco.MjModel
    data: mujoco.MjData
    """The file's pose, in the palm's frame."""
    palm: int
    groups: dict[int, list[int]]
    """Bodies of each link, the palm's first."""
    owner: dict[int, int]
    """Link of each body."""
    ends: tuple[int, ...]
    """Last link of each finger."""
    names: dict[int, str]
    """Name of each link for a hand file."""

    def above(self, link: int) -> int:
        """The link that carries one other than the palm."""
        return self.owner[int(self.model.body_parentid[link])]

    def joints(self, link: int) -> list[int]:
        """Indices of the joints between a link and the one above."""
        return [] if link == self.palm else hinges(self.model, link)


def identifier(name: str, other: str) -> str:
    """Returns a valid name for a hand file, or another if the file has none."""
    return re.sub(r"\W+", "_", name).strip("_") or other


def renamed(kind: str, before: Iterable[str], after: Iterable[str]) -> list[str]:
    """Returns a note on names that changed because others have them, if there are any."""
    changed = [f"{old} -> {new}" for old, new in zip(before, after, strict=True) if old != new]
    return listed(f"{kind} renamed, as others have their names", changed)


def hinges(model: mujoco.MjModel, body: int) -> list[int]:
    """Indices of a body's joints."""
    start, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    return list(range(start, start + count))


def hand_tree(model: mujoco.MjModel, wanted: str, notes: list[str]) -> Tree:
    """Returns the hand of a model.

    Args:
      model: model with a hand.
      wanted: body of the palm, or empty.
      notes: doubts are appended.

    Raises:
      CongraspError: there is no body of that name.
    """
    names = [model.body(i).name for i in range(model.nbody)]
    if wanted and wanted not in names:
        raise CongraspError(
            f"There is no body '{wanted}'.", f"Pass one of: {', '.join(filter(None, names))}."
        )
    palm = names.index(wanted) if wanted else _palm(model, notes)
    owner, groups, loose = {palm: palm}, {palm: [palm]}, list[str]()
    for body in range(palm + 1, model.nbody):
        if (
            not model.body_parentid[body]
            and mujoco.mjtJoint.mjJNT_FREE in model.jnt_type[hinges(model, body)]
        ):
            loose.append(names[body] or f"body {body}")
        elif int(model.body_parentid[body]) in owner:
            owner[body] = max(palm, int(model.body_weldid[body]))
            groups.setdefault(owner[body], []).append(body)
    notes += listed("not of the hand, and left out", loose)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    _to_palm(data, palm)
    depth = {palm: 0}
    root = {palm: palm}
    for link in groups:
        if link != palm:
            above = owner[int(model.body_parentid[link])]
            depth[link], root[link] = depth[above] + 1, link if above == palm else root[above]
    last: dict[int, int] = {}  # where a finger branches again, the tip is on its longest branch
    for link in groups:
        if link != palm and depth[link] > depth.get(last.get(root[link], palm), 0):
            last[root[link]] = link
    called = ["palm", *(identifier(names[link], f"body_{link}") for link in groups if link != palm)]
    numbered = distinct_names(called, str)
    notes += renamed("links", called, numbered)
    return Tree(
        model,
        data,
        palm,
        groups,
        owner,
        tuple(last.values()),
        dict(zip(groups, numbered, strict=True)),
    )


def _to_palm(data: mujoco.MjData, palm: int) -> None:
    """Transforms positions and axes of the simulation from the world frame to the palm's frame."""
    turn, origin = data.xmat[palm].reshape(3, 3).copy(), data.xpos[palm].copy()
    for places in (data.xpos, data.xipos, data.xanchor, data.geom_xpos):
        places[:] = (places - origin) @ turn
    data.xaxis[:] = data.xaxis @ turn
    for frames in (data.ximat, data.geom_xmat):
        frames[:] = (turn.T @ frames.reshape(-1, 3, 3)).reshape(-1, 9)


def _palm(model: mujoco.MjModel, notes: list[str]) -> int:
    """Body with most branches; among several, one named as a palm, the last from the root."""
    carrier = model.body_weldid  # for each body, the one whose joints move it
    branches: dict[int, int] = {}
    for body in np.flatnonzero(model.body_jntnum).tolist():
        if not _is_free(model, body):
            parent = int(carrier[model.body_parentid[body]])
            branches[parent] = branches.get(parent, 0) + 1
    found = {link: _forks(model, link) for link, count in branches.items() if count > 1} or {0: [0]}
    most = max(branches.get(link, 0) for link in found)
    best = [link for link in found if branches.get(link, 0) == most]
    called = [link for link in best if _called(model, found[link][0])]
    chosen = max(called or best)
    palm = found[chosen][0]
    choices = [body for link in best for body in found[link] if body or len(found[link]) > 1]
    others = [model.body(body).name for body in choices if body != palm]
    if others:
        notes.append(f"the palm could also be {' or '.join(others)} (--palm)")
    return palm


def _called(model: mujoco.MjModel, body: int) -> bool:
    """True if a body is named as a palm."""
    return any(word in model.body(body).name.lower() for word in _CALLED)


def _is_free(model: mujoco.MjModel, body: int) -> bool:
    """True if a body floats or has a ball joint."""
    return any(mujoco.mjtJoint(model.jnt_type[j]) in _FREE for j in hinges(model, body))


def _forks(model: mujoco.MjModel, link: int) -> list[int]:
    """Body of a link whose bodies carry all of its branches: the world body may be a fixed mount
    below.

    If that is the world itself, and the bodies with several of them are named as palms, these, of
    several hands, and the world.
    """
    moved = np.array(
        [body for body in np.flatnonzero(model.body_jntnum).tolist() if not _is_free(model, body)]
    )
    carriers = [int(body) for body in model.body_parentid[moved] if model.body_weldid[body] == link]
    if len(set(carriers)) == 1:
        return carriers[:1]
    paths = []
    for body in carriers:
        path = [body]
        while path[-1] != link:
            path.append(int(model.body_parentid[path[-1]]))
        paths.append(path)
    fork = next(body for body in paths[0] if all(body in path for path in paths))
    palms = [body for body, count in Counter(carriers).items() if count > 1 and body]
    return (
        [*palms, 0]
        if not fork and len(palms) > 1 and all(_called(model, body) for body in palms)
        else [fork]
    )


def placed(tree: Tree, link: int, *, colliding: bool) -> list[trimesh.Trimesh]:
    """Meshes of a link's geometry, m: of each body what collides or does not, or all of it if there
    is none of that.
    """
    model, data, found = tree.model, tree.data, []
    for body in tree.groups[link]:
        mine = np.flatnonzero(model.geom_bodyid == body)
        chosen = ((model.geom_contype[mine] | model.geom_conaffinity[mine]) > 0) == colliding
        for g in (mine[chosen] if chosen.any() else mine).tolist():
            if (mesh := geom_mesh(model, g)) is not None:
                mesh.vertices = (
                    mesh.vertices @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g]
                )
                found.append(mesh)
    return found


def solids_of(tree: Tree, link: int) -> tuple[Solid, ...]:
    """Collision geometry of a link; empty if there is none, or a mesh is among it."""
    model, data, found = tree.model, tree.data, []
    for g in np.flatnonzero(np.isin(model.geom_bodyid, tree.groups[link])):
        if not model.geom_contype[g] | model.geom_conaffinity[g]:
            continue
        kind, size = _KINDS.get(mujoco.mjtGeom(model.geom_type[g])), model.geom_size[g].copy()
        if kind is None:
            return ()
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_SPHERE:
            size = np.repeat(size[0], 3)
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, data.geom_xmat[g])
        w, x, y, z = quaternion.round(9).tolist()
        place = vector(data.geom_xpos[g].round(6))
        found.append(Solid(kind, vector(size.round(6)), place, (w, x, y, z)))
    return tuple(found)


def geom_mesh(model: mujoco.MjModel, g: int) -> trimesh.Trimesh | None:
    """Mesh of a geom in its frame; None for a plane."""
    kind, size = mujoco.mjtGeom(model.geom_type[g]), model.geom_size[g]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        m = model.geom_dataid[g]
        vertices = slice(model.mesh_vertadr[m], model.mesh_vertadr[m] + model.mesh_vertnum[m])
        faces = slice(model.mesh_faceadr[m], model.mesh_faceadr[m] + model.mesh_facenum[m])
        return trimesh.Trimesh(model.mesh_vert[vertices], model.mesh_face[faces], process=False)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(2 * size)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(1, size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(2 * size[1], size[0], count=(8, 8))
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(size[0], 2 * size[1], sections=12)
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        ball = trimesh.creation.icosphere(1)
        ball.vertices *= size
        return ball
    return None


def link_mesh(tree: Tree, link: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Visual mesh of a link; None if there is none."""
    parts = placed(tree, link, colliding=False)
    if not parts:
        return None
    joined: Any = trimesh.util.concatenate(parts)
    whole = trimesh.Trimesh(joined.vertices, joined.faces)
    if len(whole.faces) > MAX_FACES:
        whole = whole.simplify_quadric_decimation(face_count=MAX_FACES)
    if not 0 < len(whole.faces) <= MAX_FACES:  # many separate parts cannot be simplified that far
        outer = np.asarray(joined.convex_hull.vertices)
        # A hull of N points has 2 N - 4 faces
        directions = np.random.default_rng(0).normal(size=(3, MAX_FACES // 2))
        whole = trimesh.Trimesh(outer[np.unique((outer @ directions).argmax(0))]).convex_hull
    return np.asarray(whole.vertices, np.float32), np.asarray(whole.faces, np.int32)


def inertia_boxes(tree: Tree, link: int) -> list[np.ndarray]:
    """Corners of the boxes with the mass and inertia of a link's bodies, where the file has them
    and a link's size.
    """
    model, data, found = tree.model, tree.data, []
    for body in tree.groups[link]:
        mass, (x, y, z) = model.body_mass[body], model.body_inertia[body]
        if mass < 1e-4 or (mass, x, y, z) == (LEAST[0], *3 * (LEAST[1],)):
            continue
        half = np.sqrt(np.maximum(1.5 * np.array([y + z - x, x + z - y, x + y - z]) / mass, 0.0))
        if _PLAUSIBLE[0] <= half.max() <= _PLAUSIBLE[1]:
            corners = np.array(trimesh.creation.box(2 * np.maximum(half, _PLAUSIBLE[0])).vertices)
            found += list(corners @ data.ximat[body].reshape(3, 3).T + data.xipos[body])
    return found


def bare(*centers: np.ndarray) -> list[np.ndarray]:
    """Points around centres, for a link without geometry in the file."""
    return [c + _BARE * d for c in centers for d in np.concatenate([np.eye(3), -np.eye(3)])]


def fit_capsules(points: np.ndarray) -> tuple[Capsule, ...]:
    """Fits capsules along the longest side of the points' box (n, 3); several in parallel if it is
    flat.
    """
    if np.linalg.matrix_rank(points - points.mean(0), tol=_THIN) < 3:
        few = np.unique(points.round(5), axis=0)
        points = np.concatenate([few + d for d in _THIN * np.concatenate([np.eye(3), -np.eye(3)])])
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


def far_end(capsules: tuple[Capsule, ...], origin: np.ndarray) -> np.ndarray:
    """Mean (3,) of the capsules' ends that are farther from a point (3,): the tip of a finger."""
    ends = [
        max(
            (capsule.start, capsule.end),
            key=lambda end: float(np.linalg.norm(np.subtract(end, origin))),
        )
        for capsule in capsules
    ]
    return np.mean(ends, axis=0)
