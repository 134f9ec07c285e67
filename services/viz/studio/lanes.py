"""What became of each constraint, step by step: a lane is green where the hand keeps to it."""

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from common.hands import get_hand
from common.hands.kinematics import grasp_frame
from common.hands.spec import Hand, link_origin
from common.task.types import MASKS
from common.wire.codec import Message
from services.assets.hands.kinematics import mujoco_link_poses

HEADING = (0.25, 0.03)
"""Errors (rad, m) up to which the hand keeps to a heading: those of a grasp that may become a reference."""
POSE = (0.25, 0.03)
"""The same for a reference pose: mean of the joints' errors, and the wrist's distance."""
TRAJECTORY = (0.3, 0.03)
"""The same for a wrist trajectory."""
TOUCH = 0.05
"""Newtons from which a link counts as touching."""


class Lane(NamedTuple):
    """One constraint over T steps."""

    met: np.ndarray
    """(T,) bool."""
    counts: np.ndarray
    """(T,) bool: the constraint is meant for this step (a heading for the grasp, a path for the approach)."""
    words: str
    """What is measured, and up to where it is met."""
    errors: Mapping[str, np.ndarray]
    """(T,) by name with its unit."""


def lanes(episode: Message) -> dict[str, Lane]:
    """The lanes of an episode: contact, then the active constraints by name.

    The errors are those of `common.task.metrics`, with two exceptions: a wrist is on its path wherever it is near it,
    not only near the waypoint that it is led to, and the affordance goes by the surface point nearest to a link.
    """
    a = {name: np.asarray(value) for name, value in episode.arrays.items()}
    hand = get_hand(str(episode.meta["hand"]))
    mask = dict(zip(MASKS, a["goal/mask"] > 0, strict=True))
    table = a["table"].astype(bool)
    touching = np.linalg.norm(a["contact_force"], axis=-1) > TOUCH
    turn = _turn(a["object_quaternion"])
    wrist = _turn(a["link_quaternion"][:, 0])
    links = touching.sum(-1)
    found = {"contact": Lane(links >= 2, ~table, "two links or more touch the object", {"links": links.astype(float)})}
    found["heading"] = _heading(hand, a, turn, wrist, table)
    if mask["affordance"]:
        wrong = touching & _nearest_is_minus(hand, a, turn)
        lane = {"links on O-": wrong.sum(-1).astype(float)}
        found["affordance"] = Lane(~wrong.any(-1), np.ones(len(table), bool), "no link touches what is painted", lane)
    if mask["pose_finger"]:
        found["pose"] = _pose(a, turn, wrist, table, whole=bool(mask["pose_wrist"]))
    if mask["trajectory"]:
        found["trajectory"] = _trajectory(a, turn, wrist, table)
    return found


def _heading(hand: Hand, a: Mapping[str, np.ndarray], turn: Rotation, wrist: Rotation, table: np.ndarray) -> Lane:
    direction = turn.apply(a["goal/heading_direction"])
    target = turn.apply(a["goal/heading_position"]) + a["object_position"]
    own = wrist.apply(grasp_frame(hand).heading)
    sine = np.linalg.norm(np.cross(own, direction), axis=-1)
    angle = np.arctan2(sine, (own * direction).sum(-1))
    off = _center(hand, a) - target
    aside = np.linalg.norm(off - (off * direction).sum(-1, keepdims=True) * direction, axis=-1)
    met = (angle <= HEADING[0]) & (aside <= HEADING[1])
    words = f"direction within {np.degrees(HEADING[0]):.0f}°, {100 * HEADING[1]:.0f} cm beside the arrow at most"
    return Lane(met, ~table, words, {"rad": angle, "m": aside})


def _pose(a: Mapping[str, np.ndarray], turn: Rotation, wrist: Rotation, table: np.ndarray, *, whole: bool) -> Lane:
    angles = np.abs(a["q"] - a["goal/pose_q"]).mean(-1)
    target = turn.apply(a["goal/pose_position"]) + a["object_position"]
    far = np.linalg.norm(a["link_position"][:, 0] - target, axis=-1)
    met = (angles <= POSE[0]) & ((far <= POSE[1]) | (not whole))
    words = f"finger joints within {np.degrees(POSE[0]):.0f}° on average"
    errors = {"rad": angles, **({"m": far} if whole else {})}
    return Lane(met, ~table, words + (f", wrist within {100 * POSE[1]:.0f} cm" if whole else ""), errors)


def _trajectory(a: Mapping[str, np.ndarray], turn: Rotation, wrist: Rotation, table: np.ndarray) -> Lane:
    local = turn.inv().apply(a["link_position"][:, 0] - a["object_position"])
    path = a["goal/trajectory_position"]
    legs = itertools.pairwise(path)
    far = np.min([_to_segment(local, start[None], end[None])[0] for start, end in legs], axis=0)
    index = np.linalg.norm(local[:, None] - path[None], axis=-1).argmin(-1)
    target = turn * _turn(a["goal/trajectory_quaternion"][index])
    angle = (target.inv() * wrist).magnitude()
    met = (angle <= TRAJECTORY[0]) & (far <= TRAJECTORY[1])
    words = f"wrist within {100 * TRAJECTORY[1]:.0f} cm and {np.degrees(TRAJECTORY[0]):.0f}° of the path"
    return Lane(met, table, words, {"rad": angle, "m": far})


def _center(hand: Hand, a: Mapping[str, np.ndarray]) -> np.ndarray:
    """(T, 3) the hand's centre: middle between the thumb's tip and the mean of the others."""
    tips = np.array(
        [
            _turn(a["link_quaternion"][:, i]).apply(
                np.subtract(hand.links[i].tip or (0.0, 0.0, 0.0), link_origin(hand.links[i]))
            )
            + a["link_position"][:, i]
            for i in hand.tip_links
        ]
    )
    return 0.5 * (tips[0] + tips[1:].mean(0))


def _nearest_is_minus(hand: Hand, a: Mapping[str, np.ndarray], turn: Rotation) -> np.ndarray:
    """(T, L) whether the surface point nearest to each link's skin belongs to O-."""
    points, minus = a["surface_points"], a["surface_minus"].astype(bool)
    back = turn.inv()
    result = np.zeros(a["link_position"].shape[:2], bool)
    for i, link in enumerate(hand.links):
        own = _turn(a["link_quaternion"][:, i])
        nearest = np.full((len(result), len(points)), np.inf)
        for capsule in link.capsules:
            ends = [
                back.apply(
                    own.apply(np.subtract(end, link_origin(link))) + a["link_position"][:, i] - a["object_position"]
                )
                for end in (capsule.start, capsule.end)
            ]
            nearest = np.minimum(nearest, _to_segment(points, *ends) - capsule.radius)
        result[:, i] = minus[nearest.argmin(-1)]
    return result


def _turn(quaternion: Any) -> Rotation:
    """Rotations of quaternions (..., 4), w x y z."""
    return Rotation.from_quat(quaternion, scalar_first=True)


def _to_segment(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(T, N) distances of points (N, 3) from segments (T, 3) to (T, 3)."""
    along = end - start
    length = np.maximum((along**2).sum(-1), 1e-12)
    t = np.clip(((points[None] - start[:, None]) * along[:, None]).sum(-1) / length[:, None], 0.0, 1.0)
    return np.linalg.norm(points[None] - start[:, None] - t[..., None] * along[:, None], axis=-1)


def for_page(episode: Message) -> Message:
    """The episode as the player needs it: poses, forces, rewards, object, goal, reference pose and lanes."""
    found = lanes(episode)
    keep: tuple[str, ...] = (
        "link_position",
        "link_quaternion",
        "object_position",
        "object_quaternion",
        "contact_force",
        "table",
    )
    keep += ("visual_vertices", "visual_faces", "surface_points", "surface_minus")
    arrays: dict[str, Any] = {name: episode.arrays[name] for name in keep}
    arrays |= {name: value for name, value in episode.arrays.items() if name.startswith(("reward/", "goal/"))}
    for name, lane in found.items():
        arrays |= {f"lane/{name}/met": lane.met, f"lane/{name}/counts": lane.counts}
        arrays |= {f"lane/{name}/{unit}": np.asarray(value, np.float32) for unit, value in lane.errors.items()}
    if "pose" in found:
        hand, turn = get_hand(str(episode.meta["hand"])), _turn(episode.arrays["goal/pose_quaternion"])
        position, quaternion = mujoco_link_poses(hand, np.asarray(episode.arrays["goal/pose_q"], float))
        arrays["ghost_position"] = (turn.apply(position) + episode.arrays["goal/pose_position"]).astype(np.float32)
        arrays["ghost_quaternion"] = (turn * _turn(quaternion)).as_quat(scalar_first=True).astype(np.float32)
    words = {name: lane.words for name, lane in found.items()}
    return Message(arrays, {**episode.meta, "lanes": words})
