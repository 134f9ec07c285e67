"""An episode as a 3-D scene of Foxglove: hand, object and constraints, and for each control step
frames and contacts.

Each actor has a separate frame in a row under `world`.
"""

from typing import NamedTuple

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints.markers import Arrow, Ghost, Paint, Polyline
from congrasp.services.appearance.palette import (
    AVOID,
    FLESH,
    GRASPABLE,
    HEADING,
    OBJECT,
    TABLE,
    WAYPOINT,
)
from congrasp.services.appearance.surface_colours import colours_at
from congrasp.services.record.hand_parts import surface_parts
from congrasp.services.record.primitives import (
    Rgba,
    add_arrow,
    add_ball,
    add_capsules,
    add_triangles,
    new_entity,
    point_cloud,
    set_colour,
    set_quaternion,
    set_vector,
)

SPACING_M = 0.8
"""Distance between the frames of two actors in the world frame."""
LEAST_FORCE_N = 0.05
"""Force above which a link is in contact."""
_GHOST: Rgba = (*HEADING, 0.25)
_OBJECT: Rgba = (*OBJECT, 1.0)
_TABLE: Rgba = (*TABLE, 1.0)
_HEADING: Rgba = (*HEADING, 1.0)
_WAYPOINT: Rgba = (*WAYPOINT, 1.0)
_FORCE: Rgba = (0.93, 0.26, 0.21, 1.0)
_TEXT: Rgba = (0.15, 0.17, 0.2, 1.0)
_AXES: tuple[Rgba, ...] = ((0.9, 0.2, 0.2, 1.0), (0.2, 0.7, 0.2, 1.0), (0.2, 0.3, 0.9, 1.0))
"""Colours of the axes x, y and z of a wrist."""
_APPROACH_LENGTH_M = 0.10
_APPROACH_WIDTH_M = 0.006
_AXIS_LENGTH_M = 0.05
_AXIS_WIDTH_M = 0.003
_LINE_WIDTH_M = 0.003
_BEAD_RADIUS_M = 0.004
_FORCE_LENGTH_M = 0.01
"""Length of a force's arrow, for each newton."""
_LONGEST_FORCE_M = 0.10
_FORCE_WIDTH_M = 0.004
_LABEL_SIZE_M = 0.015
_LABEL_HEIGHT_M = 0.12
"""Height of the text above the object."""
_TABLE_SIZE_M = (0.6, 0.6, 0.02)
_TABLE_CENTRE_M = (0.0, 0.0, -0.01)
_NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])


class _Frame(NamedTuple):
    """Pose of a frame in another one."""

    parent: str
    name: str
    position: np.ndarray
    """(3,) m."""
    quaternion: np.ndarray
    """(4,)."""


def link_frame(actor: str, link: str) -> str:
    """Name of the frame of a link of an actor's hand."""
    return f"{actor}/{link}"


def _object_frame(actor: str) -> str:
    """Name of the frame of an actor's object."""
    return f"{actor}/object"


def _arm_frame(actor: str, link: str) -> str:
    """Name of the frame of a link of an actor's arm."""
    return f"{actor}/arm/{link}"


def transforms(episode: Episode, actor: str, step: int, slot: int, now: int) -> FrameTransforms:
    """Frames of the actor, its links and its object at a control step.

    Args:
      episode: the episode.
      actor: name of the actor.
      step: the control step.
      slot: position of the actor in the row of actors.
      now: time of the step, ns.
    """
    message = FrameTransforms()
    for frame in _frames(episode, actor, step, slot):
        transform = message.transforms.add(parent_frame_id=frame.parent, child_frame_id=frame.name)
        transform.timestamp.FromNanoseconds(now)
        set_vector(transform.translation, frame.position)
        set_quaternion(transform.rotation, frame.quaternion)
    return message


def _frames(episode: Episode, actor: str, step: int, slot: int) -> list[_Frame]:
    """Frames at a control step: the actor's, those of the hand, the object's, those of the arm."""
    frames = [_Frame("world", actor, np.array([SPACING_M * slot, 0.0, 0.0]), _NO_TURN)]
    for k, name in enumerate(episode.link_names):
        position = episode.link_position[step, k]
        quaternion = episode.link_quaternion[step, k]
        frames.append(_Frame(actor, link_frame(actor, name), position, quaternion))
    position = episode.object_position[step]
    quaternion = episode.object_quaternion[step]
    frames.append(_Frame(actor, _object_frame(actor), position, quaternion))
    arm = episode.arm
    if arm:
        for k, name in enumerate(arm.link_names):
            position = arm.link_position[step, k]
            quaternion = arm.link_quaternion[step, k]
            frames.append(_Frame(actor, _arm_frame(actor, name), position, quaternion))
    return frames


def static_scene(episode: Episode, actor: str, now: int) -> SceneUpdate:
    """Hand, arm, object and constraints; first removes those of the previous episode.

    Args:
      episode: the episode.
      actor: name of the actor, the prefix of frames.
      now: time of the first step, ns.
    """
    update = SceneUpdate()
    update.deletions.add(type=SceneEntityDeletion.ALL).timestamp.FromNanoseconds(now)
    hand = episode.known_hand()
    _add_hand(update, hand, actor, now)
    _add_arm(update, episode, actor, now)
    _add_object(update, episode, actor, now)
    _add_constraints(update, episode, hand, actor, now)
    return update


def _add_hand(update: SceneUpdate, hand: Hand, actor: str, now: int) -> None:
    """Adds the surface of the hand, and the capsules below a skin."""
    for link, parts in zip(hand.links, surface_parts(hand), strict=True):
        entity = new_entity(update, f"hand/{link.name}", link_frame(actor, link.name), now)
        for part in parts:
            add_triangles(entity, part.points, part.faces, (*part.colour, 1.0))
        if any(part.colour == FLESH for part in parts):
            add_capsules(entity, link, (*FLESH, 1.0))


def _add_arm(update: SceneUpdate, episode: Episode, actor: str, now: int) -> None:
    """Adds the meshes of the arm, if there is one."""
    arm = episode.arm
    if arm is None:
        return
    for number, mesh in enumerate(arm.meshes):
        frame = _arm_frame(actor, arm.link_names[mesh.link])
        entity = new_entity(update, f"arm/{number}", frame, now)
        add_triangles(entity, mesh.vertices, mesh.faces, (*mesh.colour, 1.0))


def _add_object(update: SceneUpdate, episode: Episode, actor: str, now: int) -> None:
    """Adds the object in its colours, and a text above it."""
    frame = _object_frame(actor)
    vertices = episode.object_vertices
    entity = new_entity(update, "object", frame, now)
    body = add_triangles(entity, vertices, episode.object_faces, _OBJECT)
    if episode.colours:
        for colour in (colours_at(vertices, episode.colours) / 255).tolist():
            set_colour(body.colors.add(), (*colour, 1.0))
    result = "success" if episode.success else "no success"
    text = new_entity(update, "label", frame, now).texts.add(
        billboard=True,
        font_size=_LABEL_SIZE_M,
        text=f"{episode.object}, version {episode.version}, {result}",
    )
    set_vector(text.pose.position, [0.0, 0.0, vertices[:, 2].max() + _LABEL_HEIGHT_M])
    set_colour(text.color, _TEXT)


def _add_constraints(
    update: SceneUpdate, episode: Episode, hand: Hand, actor: str, now: int
) -> None:
    """Adds markers of the active constraints; the avoid region is in the cloud of surface
    points.
    """
    for name, marker in episode.markers():
        if isinstance(marker, Paint):
            continue
        entity = new_entity(update, f"constraint/{name}", _object_frame(actor), now)
        if isinstance(marker, Arrow):
            start = marker.tip - _APPROACH_LENGTH_M * marker.direction
            add_arrow(
                entity, start, marker.direction, _APPROACH_LENGTH_M, _APPROACH_WIDTH_M, _HEADING
            )
        elif isinstance(marker, Polyline):
            _add_beads(entity, marker.points)
        else:
            _add_ghost(entity, hand, marker)


def _add_beads(entity: SceneEntity, points: np.ndarray) -> None:
    """Adds a line through points (n, 3), with a ball at each."""
    line = entity.lines.add(type=LinePrimitive.LINE_STRIP, thickness=_LINE_WIDTH_M)
    line.pose.orientation.w = 1.0
    set_colour(line.color, _WAYPOINT)
    for point in points:
        set_vector(line.points.add(), point)
        add_ball(entity, point, _BEAD_RADIUS_M, _WAYPOINT)


def _add_ghost(entity: SceneEntity, hand: Hand, ghost: Ghost) -> None:
    """Adds the axes of a wrist, and the surface of its hand if the finger angles are given."""
    wrist = Rotation.from_quat(ghost.quaternion, scalar_first=True)
    for axis, colour in zip(wrist.as_matrix().T, _AXES, strict=True):
        add_arrow(entity, ghost.position, axis, _AXIS_LENGTH_M, _AXIS_WIDTH_M, colour)
    if ghost.q is None:
        return
    position, quaternion = mujoco_link_poses(hand, ghost.q)
    for k, parts in enumerate(surface_parts(hand)):
        turn = wrist * Rotation.from_quat(quaternion[k], scalar_first=True)
        for part in parts:
            points = turn.apply(part.points) + wrist.apply(position[k]) + ghost.position
            add_triangles(entity, points.astype(np.float32), part.faces, _GHOST)


def surface_cloud(episode: Episode, actor: str, now: int) -> PointCloud:
    """The object's surface points: graspable region green, avoid region red."""
    colours = np.where(episode.surface_avoid[:, None], AVOID, GRASPABLE)
    return point_cloud(_object_frame(actor), episode.surface_points, colours, now)


def contacts(episode: Episode, actor: str, step: int, now: int, lifetime: int) -> SceneUpdate:
    """Table and contact forces of a control step.

    Args:
      episode: the episode.
      actor: name of the actor, the prefix of frames.
      step: the control step.
      now: time of the step, ns.
      lifetime: time for which they are shown, ns.
    """
    update = SceneUpdate()
    if episode.table[step]:
        cube = new_entity(update, "table", actor, now, lifetime=lifetime).cubes.add()
        set_vector(cube.pose.position, _TABLE_CENTRE_M)
        cube.pose.orientation.w = 1.0
        set_vector(cube.size, _TABLE_SIZE_M)
        set_colour(cube.color, _TABLE)
    entity = new_entity(update, "forces", actor, now, lifetime=lifetime)
    for k, force in enumerate(episode.link_force[step]):
        strength = float(np.linalg.norm(force))
        if strength > LEAST_FORCE_N:
            start = episode.link_position[step, k]
            length = min(_FORCE_LENGTH_M * strength, _LONGEST_FORCE_M)
            add_arrow(entity, start, force / strength, length, _FORCE_WIDTH_M, _FORCE)
    return update
