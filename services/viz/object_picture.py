"""A picture of one object: its labelled surface, its convex pieces, and headings on the table."""

import pathlib

import numpy as np

from common.constraints.headings import Headings, clear_table, feasible
from common.errors import CongraspError
from common.objects import shapes
from common.objects.spec import GraspObject

_GRASPABLE, _AVOID, _ARROW, _GREY = "#2a9d3a", "#d1495b", "#2b6cb0", "#b0b4b8"
_ARROWS = 24


def draw_object(obj: GraspObject, headings: Headings, path: pathlib.Path) -> None:
    """Writes a PNG with three views of the object in its most likely resting pose.

    Left: surface points, the graspable region green and the avoid region red. Middle: the convex pieces. Right: some of
    the headings that the table leaves, drawn from 8 cm before the heading position up to it.

    Raises:
      CongraspError: the file cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    pose = obj.rest_poses[0]
    turn = shapes.matrix(pose[3:])

    def world(points: np.ndarray) -> np.ndarray:
        """Points (n, 3) of the object frame in the world."""
        return points @ turn.T + pose[:3]

    cleared = clear_table(headings, pose)
    chosen = np.flatnonzero(feasible(cleared, pose))[:_ARROWS]
    start = world(cleared.position - 0.08 * cleared.direction)[chosen]
    points, solid = world(obj.points), world(obj.visual_vertices)[obj.visual_faces]
    everything = [np.concatenate([points, start]), points, points]
    figure, axes = plt.subplots(1, 3, figsize=(15, 5.5), subplot_kw={"projection": "3d"})
    for axis, title, extent in zip(
        axes,
        ("surface: graspable green, avoid red", f"{len(obj.pieces)} convex pieces", "headings"),
        everything[::-1],
        strict=True,
    ):
        center, half = (extent.max(0) + extent.min(0)) / 2, np.ptp(extent, axis=0).max() / 2
        for limits, middle in zip((axis.set_xlim, axis.set_ylim, axis.set_zlim), center, strict=True):
            limits(middle - half, middle + half)
        axis.set_box_aspect((1, 1, 1))
        axis.set_title(title)
        axis.tick_params(labelsize=6)
    avoid = obj.non_graspable_points
    for which, color in ((avoid, _AVOID), (~avoid, _GRASPABLE)):
        axes[0].scatter(*points[which].T, s=8, color=color)
    for i, piece in enumerate(obj.pieces):
        vertices, faces = shapes.tessellate(piece)
        axes[1].add_collection3d(
            Poly3DCollection(world(vertices)[faces], facecolor=f"C{i}", edgecolor="black", linewidth=0.2, alpha=0.7)
        )
    axes[2].add_collection3d(Poly3DCollection(solid, facecolor=_GREY, alpha=0.4))
    if len(chosen):
        axes[2].quiver(*start.T, *(0.08 * cleared.direction[chosen] @ turn.T).T, color=_ARROW, arrow_length_ratio=0.2)
    figure.suptitle(f"{obj.name}: {1000 * obj.mass:.0f} g, resting pose 1 of {len(obj.rest_poses)} (metres)")
    figure.tight_layout()
    try:
        figure.savefig(path, dpi=90)
    except OSError as error:
        raise CongraspError(f"The picture cannot be written to {path}: {error.strerror}.") from None
    finally:
        plt.close(figure)
