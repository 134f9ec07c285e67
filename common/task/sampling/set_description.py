"""Text about the content of a constraint set."""

import numpy as np

from congrasp.common.wire.codec import Message


def describe(constraints: Message) -> dict[str, str]:
    """Describes the content of a set as text by name."""
    arrays = constraints.arrays
    meta = constraints.meta
    avoid = arrays["surface/avoid"]
    headings = arrays["heading/allowed"].shape[2]
    poses = arrays["pose/allowed"].shape[2]
    texts = {
        "hand": f"{meta['hand']}, {len(meta['finger_joints'])} finger joints",
        "object": f"{meta['object']} ({meta['object_digest']}){_scale_text(meta['object_scale'])}",
        "avoid region": f"{avoid.mean():.0%} of {len(avoid)} surface points",
        "headings": f"{headings} for each of: {', '.join(meta['variants'])}",
        "reference poses": f"{poses} for each",
        "wrist trajectories": _trajectories_text(arrays["trajectory/position"]),
    }
    if "source" in meta:
        texts["captured"] = f"{meta['source']}: {', '.join(meta['demonstrations'])}"
    for rest in range(len(arrays["rest"])):
        texts[f"resting pose {rest + 1}"] = _rest_text(constraints, rest)
    return texts


def _scale_text(scale: float) -> str:
    """Scale relative to the object's file, if it is not 1."""
    if scale == 1.0:
        return ""
    return f", {scale:g} times as large, for this hand"


def _trajectories_text(waypoints: np.ndarray) -> str:
    """Number of waypoints (V, M, K, 3), and range of the lengths."""
    length = np.linalg.norm(np.diff(waypoints, axis=2), axis=-1).sum(-1)
    return (
        f"equally many, {waypoints.shape[2]} waypoints, {100 * length.min():.0f} to "
        f"{100 * length.max():.0f} cm long; each ends at its pose"
    )


def _rest_text(constraints: Message, rest: int) -> str:
    """Height of a resting pose, and numbers of headings and poses that clear the table."""
    arrays = constraints.arrays
    counts = []
    for region, name in enumerate(constraints.meta["variants"]):
        headings = int(arrays["heading/allowed"][region, rest].sum())
        poses = int(arrays["pose/allowed"][region, rest].sum())
        counts.append(f"{name}: {headings} headings, {poses} poses")
    height = 100 * arrays["rest"][rest][2]
    return f"{height:.1f} cm high; clear of the table on the {'; '.join(counts)}"
