"""Specification of an object: convex pieces, a labelled surface, mass and resting poses.

The object frame has its origin at the centre of mass; its orientation is that of the source.
Quaternions are (w, x, y, z).
"""

import dataclasses
from typing import Literal, NamedTuple, get_args

import numpy as np

from congrasp.common import mirror

PieceKind = Literal["box", "cylinder", "capsule", "ellipsoid", "mesh"]
PIECE_KINDS: tuple[PieceKind, ...] = get_args(PieceKind)
"""In the order of their numbers in files and messages."""
SURFACE_POINTS = 512
COLOUR_POINTS = 32_768
"""Greatest number of coloured surface points, if the object has colours."""
PRIMITIVE_SLOTS = {"box": 3, "cylinder": 2, "capsule": 3, "ellipsoid": 2}
"""Most pieces of each kind in a primitive object: the geoms reserved for the object in a batched
environment.
"""
SURFACE_ERROR = 0.005
"""Deviation of an imported shape's surface above which it is unreliable, m."""
VOLUME_ERROR = 0.5
"""Deviation of an imported shape's volume above which it is unreliable, as a share of the mesh's
volume.
"""
MAX_MESH_PIECES = 48
"""Most convex pieces of an object with mesh pieces."""
MAX_MESH_VERTICES = 64
"""Most vertices of a mesh piece."""


@dataclasses.dataclass(frozen=True)
class Piece:
    """A convex collision piece in the object frame.

    `size` follows MuJoCo: half extents of a box; radius and half length (along z) of a cylinder or
    capsule; radii of an ellipsoid; zeros for a mesh, whose `vertices` (V, 3) are in the piece's
    frame (`pos`, `quat`).
    """

    kind: PieceKind
    size: tuple[float, float, float]
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    vertices: np.ndarray | None = None
    part: int = 0
    """Index into the object's `part_names`."""

    def mirrored(self) -> "Piece":
        """The mirror image of the piece; all kinds but meshes are symmetric in their frames."""
        x, y, z = self.pos
        a, b, c, d = self.quat
        vertices = None if self.vertices is None else mirror.vector(self.vertices)
        return dataclasses.replace(self, pos=(-x, y, z), quat=(a, b, -c, -d), vertices=vertices)

    def scaled(self, factor: float) -> "Piece":
        """The piece with all lengths multiplied by `factor`."""
        return dataclasses.replace(
            self,
            size=_scaled(self.size, factor),
            pos=_scaled(self.pos, factor),
            vertices=None if self.vertices is None else factor * self.vertices,
        )


class Colours(NamedTuple):
    """Colours of points of a surface; pictures take a mean of those nearby, by distance."""

    points: np.ndarray
    """(P, 3) float32, m."""
    values: np.ndarray
    """(P, 3) uint8 sRGB."""


@dataclasses.dataclass(frozen=True)
class GraspObject:
    """An object of the catalogue.

    Shapes: `points`, `normals` (512, 3), outward unit normals; `labels` (512,) part index of each
    surface point; `graspable` (parts,) bool, parts that may be grasped by default; `inertia` (3, 3)
    about the centre of mass, kg.m^2; `rest_poses` (R, 7) position and quaternion in the world
    frame, with the table's top at z = 0; `visual_vertices` (V, 3), `visual_faces` (F, 3) for
    pictures, in the object frame; `origin` (3,) origin of the imported file in the object frame.
    """

    name: str
    family: str
    pieces: tuple[Piece, ...]
    part_names: tuple[str, ...]
    graspable: np.ndarray
    mass: float
    inertia: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    labels: np.ndarray
    rest_poses: np.ndarray
    visual_vertices: np.ndarray
    visual_faces: np.ndarray
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    file_up: Literal["y", "z"] = "z"
    """Axis of the imported file that is this object's z axis; the y axis of a file becomes z by a
    quarter turn about x."""
    file_scale: float = 1.0
    """Metres per unit of the imported file."""
    notes: tuple[str, ...] = ()
    """Repairs made by the import, and other remarks for the user."""
    surface_error: float | None = None
    """Hausdorff distance between the surface of the pieces and that of the imported mesh, m."""
    volume_error: float | None = None
    """(Volume of the pieces' union - the mesh's) / the mesh's; None if the mesh was open."""
    colours: Colours | None = None
    """Colours of the surface, in the object frame."""

    @property
    def shape_reliable(self) -> bool:
        """True if the pieces are close enough to the imported mesh for their grasps to transfer to
        it.
        """
        surface = self.surface_error or 0.0
        volume = self.volume_error or 0.0
        return surface <= SURFACE_ERROR and abs(volume) <= VOLUME_ERROR

    @property
    def non_graspable_points(self) -> np.ndarray:
        """(512,) bool: surface points of the avoid region."""
        return ~self.graspable[self.labels]

    def mirrored(self) -> "GraspObject":
        """The mirror image of the object, point by point and resting pose by resting pose
        (`common.mirror`).
        """
        sides = np.array([-1.0, 1.0, 1.0])

        x, y, z = self.origin
        rest_positions = mirror.vector(self.rest_poses[:, :3])
        rest_quats = mirror.quaternion(self.rest_poses[:, 3:])
        return dataclasses.replace(
            self,
            pieces=tuple(piece.mirrored() for piece in self.pieces),
            inertia=self.inertia * np.outer(sides, sides),
            points=mirror.vector(self.points),
            normals=mirror.vector(self.normals),
            rest_poses=np.concatenate([rest_positions, rest_quats], -1),
            visual_vertices=mirror.vector(self.visual_vertices),
            visual_faces=self.visual_faces[:, ::-1],
            origin=(-x, y, z),
            colours=self.colours
            and self.colours._replace(points=mirror.vector(self.colours.points)),
        )

    def scaled(self, factor: float, *, constant_mass: bool = False) -> "GraspObject":
        """Scales all lengths by `factor`, at the same density or, with `constant_mass`, the same
        mass.
        """
        if factor == 1.0:
            return self
        mass_factor = 1.0 if constant_mass else factor**3
        return dataclasses.replace(
            self,
            pieces=tuple(piece.scaled(factor) for piece in self.pieces),
            mass=mass_factor * self.mass,
            inertia=mass_factor * factor**2 * self.inertia,
            points=factor * self.points,
            rest_poses=self.rest_poses * np.array([factor] * 3 + [1.0] * 4),
            visual_vertices=factor * self.visual_vertices,
            origin=_scaled(self.origin, factor),
            file_scale=factor * self.file_scale,
            surface_error=None if self.surface_error is None else factor * self.surface_error,
            colours=self.colours and self.colours._replace(points=factor * self.colours.points),
        )


def _scaled(vector: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    """Returns the vector times the factor."""
    x, y, z = vector
    return factor * x, factor * y, factor * z
