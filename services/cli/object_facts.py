"""Facts of an object in words: size, parts, errors of its pieces, headings within reach."""

import collections
from typing import TYPE_CHECKING

import numpy as np

from congrasp.common.hands.files import HUMAN
from congrasp.common.objects.store import digest

if TYPE_CHECKING:
    from congrasp.common.objects.spec import GraspObject
    from congrasp.common.task.sampling.headings import Headings


def object_facts(obj: "GraspObject", headings: "Headings | None") -> dict[str, str]:
    """Returns the facts of an object by their names.

    Args:
      obj: the object.
      headings: headings on its whole surface, in the object frame; None if there is none.
    """
    graspable_share = obj.graspable[obj.labels].mean()
    graspable, avoided = part_names(obj)
    principal_inertia = [f"{1e6 * moment:.1f}" for moment in np.linalg.eigvalsh(obj.inertia)]
    facts = {
        "family": obj.family,
        "size": f"{size_text(obj)} cm",
        "mass": f"{1000 * obj.mass:.1f} g",
        "principal inertia": f"{' '.join(principal_inertia)} kg.mm²",
        "pieces": _piece_counts(obj),
        "pieces against the mesh": _shape_errors(obj),
        "graspable region": f"{graspable} ({graspable_share:.0%} of the surface)",
        "avoid region": avoided or "nothing",
        "digest": digest(obj),
    }
    return facts | _resting_pose_facts(obj, headings)


def size_text(obj: "GraspObject") -> str:
    """Returns the sides of the object's bounding box, cm."""
    sides = 100 * (obj.visual_vertices.max(0) - obj.visual_vertices.min(0))
    return " x ".join(f"{side:.1f}" for side in sides)


def part_names(obj: "GraspObject") -> tuple[str, str]:
    """Returns the names of the parts of the graspable and of the avoid region."""
    graspable: list[str] = []
    avoided: list[str] = []
    for name, is_graspable in zip(obj.part_names, obj.graspable, strict=True):
        region = graspable if is_graspable else avoided
        region.append(name)
    return ", ".join(graspable), ", ".join(avoided)


def _piece_counts(obj: "GraspObject") -> str:
    """Numbers of the object's pieces by kind."""
    counts = collections.Counter(piece.kind for piece in obj.pieces)
    return ", ".join(f"{count} {kind}" for kind, count in counts.items())


def _shape_errors(obj: "GraspObject") -> str:
    """Errors of the pieces of an imported object."""
    if obj.surface_error is None:
        return "the object is its pieces"
    volume = "" if obj.volume_error is None else f", volume {obj.volume_error:+.1%}"
    return f"surface {1000 * obj.surface_error:.1f} mm off at most{volume}"


def _resting_pose_facts(obj: "GraspObject", headings: "Headings | None") -> dict[str, str]:
    """Height of each resting pose, and shares of the headings that the human hand can use in it."""
    from congrasp.common.task.sampling.heading_sampler import sample_headings

    on_graspable = sample_headings(obj, np.random.default_rng(0), use_affordance=True)
    anywhere_shares = _reachable_shares(obj, headings)
    graspable_shares = _reachable_shares(obj, on_graspable, obj.non_graspable_points)
    facts = {}
    for index, pose in enumerate(obj.rest_poses):
        facts[f"resting pose {index + 1}"] = (
            f"{100 * pose[2]:.1f} cm high; headings within reach of the human hand "
            f"{anywhere_shares[index]}, on the graspable region {graspable_shares[index]}"
        )
    return facts


def _reachable_shares(
    obj: "GraspObject", headings: "Headings | None", avoid: np.ndarray | None = None
) -> list[str]:
    """Shares of headings that the human hand can use in each resting pose, and those from above.

    Args:
      obj: the object.
      headings: headings in the object frame; None if there is none.
      avoid: mask of the surface points that the hand must not touch.
    """
    from congrasp.common.hands.closure import outline
    from congrasp.common.task.sampling.reach import above, within_reach

    if headings is None:
        return ["none"] * len(obj.rest_poses)
    cleared, reachable = within_reach(headings, obj, obj.rest_poses, outline(HUMAN), avoid)
    shares = []
    for index, pose in enumerate(obj.rest_poses):
        from_above = reachable[index] & above(cleared[index], pose)
        shares.append(f"{reachable[index].mean():.0%} ({from_above.mean():.0%} from above)")
    return shares
