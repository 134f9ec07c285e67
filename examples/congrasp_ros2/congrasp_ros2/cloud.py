"""Visible surface of the object in a camera's point clouds, for the node with a camera
policy.
"""

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import congrasp
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.hands.spec import Hand, capsule_ends
from congrasp.common.objects.procedural import plain_object
from congrasp.common.objects.spec import GraspObject, Piece
from congrasp_ros2.sensors import Pose

FLOOR = 0.005
"""Height above the table from which a point belongs to the object, m."""
_FEWEST = 16  # least number of points of an object
_MOST = 50_000  # greatest number of points used of a message
_CLEARANCE = 0.01  # m around the hand's capsules in which points belong to the hand
_KINDS = {7: "f4", 8: "f8"}  # FLOAT32 and FLOAT64 of PointField
_DENSITY = 300.0  # kg/m^3, of the box around the cloud


class Eye:
    """The object's visible surface in the newest cloud that shows it.

    Everything is in the frame that rises with the hand; until the lift that is the world frame.
    """

    def __init__(self, hand: Hand, count: int, box: str, world: str):
        """Reads the box.

        Args:
          hand: the hand, whose points are removed from the clouds.
          count: number of points that the policy observes.
          box: X Y Z DX DY DZ: middle and sides of the box in which the object is, m.
          world: name of the world frame; clouds in it do not say where the camera is.

        Raises:
          CongraspError: the box is no six numbers, or a side is not positive.
        """
        try:
            middle, sides = np.array(box.split(), float).reshape(2, 3)
        except ValueError:
            middle, sides = np.zeros(3), np.zeros(3)
        if not (np.isfinite(middle).all() and (sides > 0).all()):
            raise congrasp.CongraspError(
                f"--box is '{box}'.", "Write its middle and sides in metres: 0.5 0 0.2 0.4 0.4 0.4"
            )
        self._low, self._high = middle - sides / 2, middle + sides / 2
        self._low[2] = max(self._low[2], FLOOR)
        self._hand, self._count, self._world = hand, count, world
        self._last: Any = None
        self.points: np.ndarray | None = None
        """(count, 3) m; None until an object was seen."""
        self.camera: dict[str, np.ndarray] = {}
        """Its position, m, when it saw them, as the field `camera_position` of a query; none if it
        is unknown.
        """
        self.seen = ""
        """Text that counts the newest cloud's points on the object."""

    def look(self, message: Any, camera: Pose, palm: Pose, q: np.ndarray) -> None:
        """Updates the points from a new PointCloud2; they stay if it is the last one again, or
        hides the object.

        Args:
          message: the cloud.
          camera: pose of its frame.
          palm: pose of the hand's palm.
          q: (F,) finger angles, rad.
        """
        if message is self._last:
            return
        self._last = message
        points = everything = read_points(message)
        points = camera.rotation.apply(points) + camera.position if len(points) else points
        points = points[((points >= self._low) & (points <= self._high)).all(-1)]
        points = points[~self._on_hand(points, palm, q)]
        self.seen = (
            f"{len(points)} of {len(everything)} points in --box above the table, and none of the "
            f"hand's"
        )
        if len(points) >= _FEWEST:
            self.points = points[np.arange(self._count) * len(points) // self._count]
            self.camera = (
                {}
                if message.header.frame_id == self._world
                else {"camera_position": camera.position}
            )

    def _on_hand(self, points: np.ndarray, palm: Pose, q: np.ndarray) -> np.ndarray:
        """(N,) true for points (N, 3) that belong to the hand."""
        local = palm.rotation.inv().apply(points - palm.position) if len(points) else points
        near = np.zeros(len(points), bool)
        for link, position, quaternion in zip(
            self._hand.links, *mujoco_link_poses(self._hand, q), strict=True
        ):
            turn = Rotation.from_quat(quaternion, scalar_first=True)
            for capsule, ends in zip(link.capsules, capsule_ends(link), strict=True):
                start, end = turn.apply(ends) + position
                along = end - start
                share = np.clip((local - start) @ along / max(along @ along, 1e-12), 0.0, 1.0)
                off = np.linalg.norm(local - start - share[:, None] * along, axis=-1)
                near |= off < capsule.radius + _CLEARANCE
        return near


def read_points(message: Any) -> np.ndarray:
    """(N, 3) finite points of a PointCloud2, evenly thinned if it is large; none if it has no x, y,
    z.
    """
    order, fields = (
        ">" if message.is_bigendian else "<",
        {field.name: field for field in message.fields},
    )
    try:
        formats = [order + _KINDS[fields[name].datatype] for name in "xyz"]
        offsets = [fields[name].offset for name in "xyz"]
        kind = np.dtype(
            {
                "names": ["x", "y", "z"],
                "formats": formats,
                "offsets": offsets,
                "itemsize": message.point_step,
            }
        )
        shape, strides = (message.height, message.width), (message.row_step, message.point_step)
        points = np.ndarray(shape, kind, bytes(message.data), strides=strides).ravel()
    except (KeyError, ValueError, TypeError):
        return np.zeros((0, 3))
    points = points[:: -(-len(points) // _MOST) or 1]
    found = np.stack([points[name] for name in "xyz"], -1).astype(float)
    return found[np.isfinite(found).all(-1)]


def seen_object(points: np.ndarray) -> GraspObject:
    """Stand-in for an object of which only points (N, 3) are known; constraints on it are in their
    frame.

    Its mass, which `--gentle` needs, is that of the box around the points at 300 kg/m^3.
    """
    low, high = points.min(0), points.max(0)
    x, y, z = np.maximum((high - low) / 2, 1e-3).tolist()
    box = Piece("box", (x, y, z), tuple(((low + high) / 2).tolist()))
    found = plain_object("cloud", (box,), _DENSITY)
    return dataclasses.replace(
        found, points=points, normals=np.zeros_like(points), labels=np.zeros(len(points), np.int32)
    )


def labelled(points: np.ndarray, first: np.ndarray, avoid: np.ndarray) -> np.ndarray:
    """(N,) avoid labels of points (N, 3): that of the nearest of the first points (M, 3), which
    have labels (M,).
    """
    return avoid[cKDTree(first).query(points)[1]]
