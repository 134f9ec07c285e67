"""An episode as a 3-D scene: link frames, the hand's surface, object, constraints, contacts and
signals, step by step.

Each actor has a separate frame in a row under `world`. Constant parts of an episode are sent once,
at its start; link frames, contacts and signals follow at each control step.
"""

import contextlib
import functools
import pathlib
import time
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import trimesh
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.hands import known_hand
from congrasp.common.hands.flesh import skeleton_of
from congrasp.common.hands.mjcf import WRIST_JOINTS, mujoco_link_poses
from congrasp.common.hands.skin import MATERIALS, Skin, skin_of, skin_on
from congrasp.common.hands.spec import Hand, Link, capsule_ends
from congrasp.common.io.spelling import check_spelling
from congrasp.common.objects.object_checks import LARGEST
from congrasp.common.objects.spec import Colours
from congrasp.common.task.constraints.markers import Arrow, Ghost, Paint, Polyline
from congrasp.common.wire.codec import Message, encode
from congrasp.common.wire.messages import EPISODE, validate
from congrasp.services.record.episode import MovedArm, arm_of_episode, markers
from congrasp.services.record.palette import (
    AVOID,
    FLESH,
    GRASPABLE,
    HEADING,
    OBJECT,
    TABLE,
    WAYPOINT,
    Colour,
    colours_at,
)
from congrasp.services.record.palette import MATERIALS as COLOURS
from congrasp.services.record.writer import (
    Entry,
    JsonChannels,
    LogWriter,
    opaque_channel,
    protobuf_channel,
)

_OVERLAP = 0.4  # weight of a link on a vertex above which the triangle belongs to the link
_MOST_FACES = 12_000  # triangles of a hand; meshes of links may have more
_GRID = 2.0**-14  # resolution of coordinates, m: few digits compress well
_POINTS = 2048  # points on a hand


class Part(NamedTuple):
    """A rigid part of a link in one colour, in the link's frame, m."""

    colour: Colour
    points: np.ndarray
    """(V, 3), within 0.05 mm."""
    faces: np.ndarray
    """(E, 3) int, with outward normals."""


@functools.lru_cache(maxsize=16)
def surface_parts(hand: Hand) -> tuple[tuple[Part, ...], ...]:
    """Rigid parts of the surface of each link, one of each material, in the link's frame; each is
    sent once.

    A human hand's skin deforms, but its points at every step would make a recording many times as
    large. A triangle of skin therefore belongs to every link with a noticeable weight on it, so
    that the parts of two links overlap at a bent joint.
    """
    skin = _skin(hand)
    strongest = np.eye(len(hand.links), dtype=bool)[skin.weights[skin.faces].sum(1).argmax(-1)]
    members = strongest | (skin.weights[skin.faces].max(1) >= _OVERLAP)
    kept = min(1.0, _MOST_FACES / len(skin.faces))
    found = []
    for member, origin in zip(members.T, skin.origins, strict=True):
        parts = []
        for number, name in enumerate(MATERIALS):
            faces = skin.faces[member & (skin.material[skin.faces[:, 0]] == number)]
            if len(faces):
                parts.append(Part(COLOURS[name], *_light(skin.points[faces] - origin, kept)))
        found.append(tuple(parts))
    return tuple(found)


@functools.lru_cache(maxsize=16)
def surface_points(hand: Hand) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Points (n, 3) on the parts of each link, in its frame, and their colours (n, 3), for viewers
    without meshes.
    """
    parts = surface_parts(hand)
    area = sum(_mesh(part).area for own in parts for part in own)
    found = []
    for own in parts:
        points, colours = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for part in own:
            mesh = _mesh(part)
            points.append(
                trimesh.sample.sample_surface(mesh, round(_POINTS * mesh.area / area), seed=0)[0]
            )
            colours.append(np.tile(part.colour, (len(points[-1]), 1)))
        found.append((np.concatenate(points), np.concatenate(colours)))
    return tuple(found)


def _skin(hand: Hand) -> Skin:
    """Surface of the hand; made of its capsules if custom meshes cannot be read."""
    with contextlib.suppress(CongraspError):
        return skin_of(hand)
    return skin_on(skeleton_of(hand))


def _light(corners: np.ndarray, kept: float) -> tuple[np.ndarray, np.ndarray]:
    """Points and faces of a share of triangles (E, 3, 3), on a grid and without duplicate
    points.
    """
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    if kept < 1.0:
        mesh = mesh.simplify_quadric_decimation(face_count=max(4, int(kept * len(mesh.faces))))
    points, found = np.unique(np.round(mesh.vertices / _GRID), axis=0, return_inverse=True)
    faces = found.reshape(-1)[mesh.faces]
    a, b, c = faces.T
    return points * _GRID, faces[(a != b) & (b != c) & (c != a)]


def _mesh(part: Part) -> trimesh.Trimesh:
    """Returns a part as a trimesh mesh."""
    return trimesh.Trimesh(part.points, part.faces, process=False)


EPISODE_SCHEMA = "congrasp.Episode"
_MOST = {"T": 2000, "V": 200_000, "Fc": 400_000, "N": 4096, "n": 64, "P": 100_000}
_GOAL, _ARRAYS = 10_000, 128
_OPEN = ("reward/", "error/", "goal/", "active/")
SPACING = 0.8
"""Distance between the frames of two actors in the world frame, m."""
Rgba = tuple[float, float, float, float]
_GHOST, _OBJECT, _TABLE = (*HEADING, 0.25), (*OBJECT, 1.0), (*TABLE, 1.0)
_HEADING, _WAYPOINT, _FORCE = (*HEADING, 1.0), (*WAYPOINT, 1.0), (0.93, 0.26, 0.21, 1.0)
_AXES = ((0.9, 0.2, 0.2, 1.0), (0.2, 0.7, 0.2, 1.0), (0.2, 0.3, 0.9, 1.0))
_ARROW = 0.10  # length of the approach arrow, m
_FORCE_LENGTH, _FORCE_MAX = 0.01, 0.10  # m per newton, and the longest arrow
_FORCE_LEAST = 0.05  # N
_NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])


def check_episode(episode: Message) -> None:
    """Validates an episode from an untrusted peer.

    Raises:
      CongraspError: the episode is invalid; the text names the array or the entry, and the violated
        rule.
    """
    hand = known_hand(episode.meta.get("hand"))
    sizes = validate(episode, EPISODE, L=len(hand.links), F=len(hand.joints))
    for symbol, most in _MOST.items():
        if not 1 <= sizes.get(symbol, 1) <= most:
            raise CongraspError(f"The episode's {symbol} is {sizes[symbol]}, not 1 to {most}.")
    if not 0.0 < episode.meta["control_dt"] <= 1.0:
        raise CongraspError("The episode's control_dt is not above 0 and at most 1 s.")
    faces = episode.arrays["visual_faces"]
    if faces.min() < 0 or faces.max() >= sizes["V"]:
        raise CongraspError("The episode's visual_faces name vertices that do not exist.")
    if ("colour_points" in episode.arrays) != ("colour_values" in episode.arrays):
        raise CongraspError("The episode has colour_points without colour_values, or the reverse.")
    for name in ("visual_vertices", "colour_points"):
        if np.abs(episode.arrays.get(name, 0.0)).max() > LARGEST:
            raise CongraspError(
                f"The episode's {name} are more than {LARGEST:g} m from the object's centre."
            )
    if any(
        array.size > _GOAL for name, array in episode.arrays.items() if name.startswith("goal/")
    ):
        raise CongraspError(f"The episode has a goal array of more than {_GOAL} values.")
    arm_of_episode(episode)
    if sum(name.startswith(_OPEN) for name in episode.arrays) > _ARRAYS:
        raise CongraspError(f"The episode has more than {_ARRAYS} rewards, errors and goal arrays.")


def save_episode(path: pathlib.Path, actor: str, episode: Message) -> None:
    """Writes an episode, under this name of an actor, as an MCAP file.

    Raises:
      CongraspError: the file cannot be written.
    """
    with os_errors_as(f"{path} could not be written"):
        check_spelling(path)
        writer = LogWriter(path.parent, f".{path.stem}", run=str(episode.meta["object"]))
        writer.write(*episode_entries(actor, episode, time.time_ns(), 0, JsonChannels()))
        writer.close()
        writer.files[-1].rename(path)


def episode_entries(
    actor: str, episode: Message, start: int, slot: int, channels: JsonChannels
) -> Iterator[Entry]:
    """Yields all entries of a recorder for one episode.

    Args:
      actor: name of the actor, the prefix of topics and frames.
      episode: the message (see `services.record`).
      start: time of its first step, ns.
      slot: position of the actor in the row of actors.
      channels: schemas of the JSON signals.

    Raises:
      LookupError, ValueError: a goal array of an active block is missing, or has the wrong shape.
    """
    topic = f"/episode/{actor}"
    arrays = {name: np.asarray(value) for name, value in episode.arrays.items()}
    hand, arm = known_hand(episode.meta["hand"]), arm_of_episode(episode)
    step = round(1e9 * episode.meta["control_dt"])
    yield Entry(opaque_channel(f"{topic}/raw", EPISODE_SCHEMA), start, encode(episode))
    yield _protobuf(
        f"{topic}/scene",
        start,
        _static_scene(hand, arm, actor, arrays, episode.meta, start),
        latched=True,
    )
    yield _protobuf(f"{topic}/surface", start, _surface(actor, arrays, start), latched=True)
    for link, (points, colours) in zip(hand.links, surface_points(hand), strict=True):
        # Rerun draws point clouds but no scenes; a topic holds one frame's cloud.
        cloud = _cloud(f"{actor}/{link.name}", points, colours, start)
        yield _protobuf(f"{topic}/hand/{link.name}", start, cloud, latched=True)
    for i in range(len(arrays["object_position"])):
        now = start + i * step
        yield _protobuf(f"{topic}/tf", now, _transforms(hand, arm, actor, arrays, i, slot, now))
        yield _protobuf(f"{topic}/contacts", now, _contacts(actor, arrays, i, now, step))
        yield channels.entry(
            f"{topic}/signals", now, _signals(hand, arrays, i, episode.meta["control_dt"])
        )


def duration(episode: Message) -> int:
    """Length of an episode in ns."""
    return round(1e9 * episode.meta["control_dt"]) * len(episode.arrays["object_position"])


def _protobuf(topic: str, time: int, message: Any, *, latched: bool = False) -> Entry:
    """Returns an entry of one of Foxglove's messages."""
    kind: Any = type(message)
    return Entry(protobuf_channel(topic, kind, latched=latched), time, message.SerializeToString())


def _transforms(
    hand: Hand,
    arm: MovedArm | None,
    actor: str,
    arrays: Mapping[str, np.ndarray],
    i: int,
    slot: int,
    now: int,
) -> FrameTransforms:
    """Frames of the actor, its links and its object at step i."""
    message = FrameTransforms()
    poses = [("world", actor, np.array([SPACING * slot, 0.0, 0.0]), _NO_TURN)]
    for k, link in enumerate(hand.links):
        poses.append(
            (
                actor,
                f"{actor}/{link.name}",
                arrays["link_position"][i, k],
                arrays["link_quaternion"][i, k],
            )
        )
    poses.append(
        (actor, f"{actor}/object", arrays["object_position"][i], arrays["object_quaternion"][i])
    )
    if arm:
        links = zip(arm.link_names, arm.link_position[i], arm.link_quaternion[i], strict=True)
        poses += [
            (actor, f"{actor}/arm/{name}", position, quaternion)
            for name, position, quaternion in links
        ]
    for parent, child, position, quaternion in poses:
        transform = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
        transform.timestamp.FromNanoseconds(now)
        _set_vector(transform.translation, position)
        _set_quaternion(transform.rotation, quaternion)
    return message


def _static_scene(
    hand: Hand,
    arm: MovedArm | None,
    actor: str,
    arrays: Mapping[str, np.ndarray],
    meta: Mapping[str, Any],
    now: int,
) -> SceneUpdate:
    """Hand, arm, object and constraints; first removes those of the previous episode."""
    update = SceneUpdate()
    update.deletions.add(type=SceneEntityDeletion.ALL).timestamp.FromNanoseconds(now)
    for link, parts in zip(hand.links, surface_parts(hand), strict=True):
        entity = _entity(update, f"hand/{link.name}", f"{actor}/{link.name}", now)
        for part in parts:
            _add_triangles(entity, part.points, part.faces, (*part.colour, 1.0))
        if any(part.colour == FLESH for part in parts):
            _add_capsules(entity, link, (*FLESH, 1.0))
    if arm:
        for m, mesh in enumerate(arm.meshes):
            entity = _entity(update, f"arm/{m}", f"{actor}/arm/{arm.link_names[mesh.link]}", now)
            _add_triangles(entity, mesh.vertices, mesh.faces, (*mesh.colour, 1.0))
    frame = f"{actor}/object"
    entity = _entity(update, "object", frame, now)
    body = _add_triangles(entity, arrays["visual_vertices"], arrays["visual_faces"], _OBJECT)
    if "colour_values" in arrays:
        own = Colours(arrays["colour_points"], arrays["colour_values"])
        for colour in (colours_at(arrays["visual_vertices"], own) / 255).tolist():
            _set_colour(body.colors.add(), (*colour, 1.0))
    text = _entity(update, "label", frame, now).texts.add(
        billboard=True, font_size=0.015, text=_label(meta)
    )
    _set_vector(text.pose.position, [0.0, 0.0, arrays["visual_vertices"][:, 2].max() + 0.12])
    _set_colour(text.color, (0.15, 0.17, 0.2, 1.0))
    _add_constraints(update, hand, frame, arrays, now)
    return update


def _label(meta: Mapping[str, Any]) -> str:
    """Text above the object."""
    return (
        f"{meta['object']}, version {meta['version']}, "
        f"{'success' if meta['success'] else 'no success'}"
    )


def _add_constraints(
    update: SceneUpdate, hand: Hand, frame: str, arrays: Mapping[str, np.ndarray], now: int
) -> None:
    """Adds markers of the active constraints; the avoid region is in the cloud of surface
    points.
    """
    for name, marker in markers(arrays):
        if isinstance(marker, Paint):
            continue
        entity = _entity(update, f"constraint/{name}", frame, now)
        if isinstance(marker, Arrow):
            start = marker.tip - _ARROW * marker.direction
            _add_arrow(entity, start, marker.direction, _ARROW, 0.006, _HEADING)
        elif isinstance(marker, Polyline):
            _add_beads(entity, marker.points)
        else:
            _add_ghost(entity, hand, marker)


def _add_beads(entity: SceneEntity, points: np.ndarray) -> None:
    """Adds balls (n, 3) on a line."""
    line = entity.lines.add(type=LinePrimitive.LINE_STRIP, thickness=0.003)
    line.pose.orientation.w = 1.0
    _set_colour(line.color, _WAYPOINT)
    for point in points:
        _set_vector(line.points.add(), point)
        _add_sphere(entity, point, 0.004, _WAYPOINT)


def _add_ghost(entity: SceneEntity, hand: Hand, ghost: Ghost) -> None:
    """Adds the axes of a wrist, and the surface of its hand if the finger angles are given."""
    wrist = Rotation.from_quat(ghost.quaternion, scalar_first=True)
    for axis, colour in zip(wrist.as_matrix().T, _AXES, strict=True):
        _add_arrow(entity, ghost.position, axis, 0.05, 0.003, colour)
    if ghost.q is None:
        return
    position, quaternion = mujoco_link_poses(hand, ghost.q)
    for k, parts in enumerate(surface_parts(hand)):
        turn = wrist * Rotation.from_quat(quaternion[k], scalar_first=True)
        for part in parts:
            points = turn.apply(part.points) + wrist.apply(position[k]) + ghost.position
            _add_triangles(entity, points.astype(np.float32), part.faces, _GHOST)


def _surface(actor: str, arrays: Mapping[str, np.ndarray], now: int) -> PointCloud:
    """The object's surface points: graspable region green, avoid region red."""
    colours = np.where(arrays["surface_avoid"][:, None], AVOID, GRASPABLE)
    return _cloud(f"{actor}/object", arrays["surface_points"], colours, now)


def _cloud(frame: str, points: np.ndarray, colours: np.ndarray, now: int) -> PointCloud:
    """Points (N, 3) of a frame with colours (N, 3) from 0 to 1."""
    packed = np.zeros(len(points), [("position", "<f4", 3), ("colour", "u1", 4)])
    packed["position"] = points
    # Foxglove's packed colours are red, green, blue, alpha in memory, one byte field each.
    packed["colour"][:, :3], packed["colour"][:, 3] = np.multiply(colours, 255), 255
    cloud = PointCloud(frame_id=frame, point_stride=packed.dtype.itemsize, data=packed.tobytes())
    cloud.timestamp.FromNanoseconds(now)
    cloud.pose.position.SetInParent()  # readers may miss an absent position
    cloud.pose.orientation.w = 1.0
    kinds = [("x", 0), ("y", 4), ("z", 8), ("red", 12), ("green", 13), ("blue", 14), ("alpha", 15)]
    for name, offset in kinds:
        kind = PackedElementField.FLOAT32 if offset < 12 else PackedElementField.UINT8
        cloud.fields.add(name=name, offset=offset, type=kind)
    return cloud


def _contacts(
    actor: str, arrays: Mapping[str, np.ndarray], i: int, now: int, step: int
) -> SceneUpdate:
    """Table and contact forces of one step, with a short lifetime."""
    update = SceneUpdate()
    if arrays["table"][i]:
        entity = _entity(update, "table", actor, now, lifetime=2 * step)
        cube = entity.cubes.add()
        _set_vector(cube.pose.position, [0.0, 0.0, -0.01])
        cube.pose.orientation.w = 1.0
        _set_vector(cube.size, [0.6, 0.6, 0.02])
        _set_colour(cube.color, _TABLE)
    entity = _entity(update, "forces", actor, now, lifetime=2 * step)
    for k, force in enumerate(arrays["contact_force"][i]):
        strength = float(np.linalg.norm(force))
        if strength > _FORCE_LEAST:
            length = min(_FORCE_LENGTH * strength, _FORCE_MAX)
            _add_arrow(
                entity, arrays["link_position"][i, k], force / strength, length, 0.004, _FORCE
            )
    return update


def _signals(
    hand: Hand, arrays: Mapping[str, np.ndarray], i: int, control_dt: float
) -> dict[str, Any]:
    """Numbers of one step: seconds, rewards, forces, joints, the object's height."""
    terms = {
        name.removeprefix("reward/"): float(a[i])
        for name, a in arrays.items()
        if name.startswith("reward/")
    }
    joints = [joint.name for joint in hand.joints]
    force = np.linalg.norm(arrays["contact_force"][i], axis=-1)
    return {
        "seconds": i * control_dt,
        "reward": {**terms, "total": sum(terms.values())},
        "force": {link.name: float(f) for link, f in zip(hand.links, force, strict=True)},
        "links_in_contact": int((force > _FORCE_LEAST).sum()),
        "q": dict(zip(joints, map(float, arrays["q"][i]), strict=True)),
        "q_target": dict(zip(joints, map(float, arrays["q_target"][i]), strict=True)),
        "wrist": dict(zip(WRIST_JOINTS, map(float, arrays["u"][i]), strict=True)),
        "wrist_target": dict(zip(WRIST_JOINTS, map(float, arrays["u_target"][i]), strict=True)),
        "object_height": float(arrays["object_position"][i, 2]),
        "table": bool(arrays["table"][i]),
    }


def _entity(
    update: SceneUpdate, name: str, frame: str, now: int, *, lifetime: int = 0
) -> SceneEntity:
    """Adds an entity that moves with its frame; without a lifetime it stays until it is replaced or
    removed.
    """
    entity = update.entities.add(id=name, frame_id=frame, frame_locked=True)
    entity.timestamp.FromNanoseconds(now)
    entity.lifetime.FromNanoseconds(lifetime)
    return entity


def _add_triangles(
    entity: SceneEntity, points: np.ndarray, faces: np.ndarray, colour: Rgba
) -> TriangleListPrimitive:
    """Adds a mesh (V, 3), (E, 3) in the entity's frame."""
    mesh = entity.triangles.add()
    mesh.pose.orientation.w = 1.0
    for point in points:
        _set_vector(mesh.points.add(), point)
    mesh.indices.extend(faces.ravel().tolist())
    _set_colour(mesh.color, colour)
    return mesh


def _add_capsules(entity: SceneEntity, link: Link, colour: Rgba) -> None:
    """Adds a link's capsules, which fill gaps in its skin at bent joints."""
    for capsule, (start, end) in zip(link.capsules, capsule_ends(link), strict=True):
        length = float(np.linalg.norm(end - start))
        if length > 0:
            cylinder = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
            _set_vector(cylinder.pose.position, (start + end) / 2)
            _set_quaternion(
                cylinder.pose.orientation, _turn_onto([0.0, 0.0, 1.0], (end - start) / length)
            )
            _set_vector(cylinder.size, [2 * capsule.radius, 2 * capsule.radius, length])
            _set_colour(cylinder.color, colour)
            _add_sphere(entity, end, capsule.radius, colour)
        _add_sphere(entity, start, capsule.radius, colour)


def _add_sphere(entity: SceneEntity, center: np.ndarray, radius: float, colour: Rgba) -> None:
    """Adds a ball."""
    sphere = entity.spheres.add()
    _set_vector(sphere.pose.position, center)
    sphere.pose.orientation.w = 1.0
    _set_vector(sphere.size, [2 * radius] * 3)
    _set_colour(sphere.color, colour)


def _add_arrow(
    entity: SceneEntity,
    start: np.ndarray,
    direction: np.ndarray,
    length: float,
    width: float,
    colour: Rgba,
) -> None:
    """Adds an arrow of some length and width (m) along a unit direction."""
    arrow = entity.arrows.add(
        shaft_length=0.7 * length,
        shaft_diameter=width,
        head_length=0.3 * length,
        head_diameter=2 * width,
    )
    _set_vector(arrow.pose.position, start)
    _set_quaternion(arrow.pose.orientation, _turn_onto([1.0, 0.0, 0.0], direction))
    _set_colour(arrow.color, colour)


def _turn_onto(axis: list[float], direction: np.ndarray) -> np.ndarray:
    """Quaternion (w, x, y, z) that rotates a unit axis to a unit direction (3,)."""
    return Rotation.align_vectors([direction], [axis])[0].as_quat(scalar_first=True)


def _set_vector(target: Any, value: Any) -> None:
    """Sets x, y and z."""
    target.x, target.y, target.z = map(float, value)


def _set_quaternion(target: Any, value: Any) -> None:
    """Sets w, x, y and z."""
    target.w, target.x, target.y, target.z = map(float, value)


def _set_colour(target: Any, value: Rgba) -> None:
    """Sets red, green, blue and alpha."""
    target.r, target.g, target.b, target.a = value
