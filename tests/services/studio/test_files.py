"""Pictures and videos of a motion as the page shows it, and why nothing held."""

import io
import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from congrasp.common.errors import CongraspError
from congrasp.common.request import GraspRequest
from congrasp.services.studio.grasping import why_nothing_held
from congrasp.services.studio.page import drawing
from tests.episodes import episode

VIEW = {"position": [0.5, -0.6, 0.4], "target": [0.0, 0.0, 0.06], "field_of_view": 32.0}


def image(view: dict[str, object], frame: int = 5) -> np.ndarray:
    found = drawing(episode(6, removal=4), "3", "png", view, frame, lambda share: None)
    assert found.name == f"cylinder-0-3-{frame}.png"
    return np.asarray(Image.open(io.BytesIO(found.data))).astype(int)


def painted(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the object's pixels: the affordance paints it red and green."""
    red, green, blue = seen[..., 0], seen[..., 1], seen[..., 2]
    return np.nonzero(((red > 2 * green) & (red > 2 * blue)) | ((green > 1.5 * red) & (green > 1.5 * blue)))


def test_a_picture_has_the_camera_of_the_page() -> None:
    seen = image(VIEW)
    rows, columns = painted(seen)
    assert seen.shape == (720, 1280, 3) and abs(np.median(columns) - 640) < 40
    # From twice as far the object is half as large along each side.
    assert len(painted(image({**VIEW, "position": [1.0, -1.2, 0.74]}))[0]) == pytest.approx(len(rows) / 4, rel=0.25)


def test_a_video_has_a_frame_for_every_40_ms() -> None:
    shares: list[float] = []
    made = drawing(episode(6, removal=4), "3", "mp4", VIEW, 0, shares.append)
    assert made.name == "cylinder-0-3.mp4" and shares[-1] == 1.0 and shares == sorted(shares)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", "-", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    frames = subprocess.run(command, input=made.data, capture_output=True, check=True).stdout
    assert len(frames) == len(shares) * 854 * 480 * 3 and len(shares) == 2  # steps 0 and 4


@pytest.mark.parametrize(
    ("kind", "view", "frame", "says"),
    [
        ("gif", VIEW, 0, "Choose from: mp4, png"),
        ("png", VIEW, 6, "no frame 6"),
        ("png", VIEW, 1.5, "no frame 1.5"),
        ("png", {**VIEW, "target": [0.0, 0.0]}, 0, "camera's target must be three numbers"),
        ("png", {**VIEW, "target": VIEW["position"]}, 0, "straight down"),
        ("png", {**VIEW, "field_of_view": 0.0}, 0, "field of view"),
        ("png", [1, 2], 0, "must have a position"),
    ],
)
def test_invalid_drawings_are_refused(kind, view, frame, says) -> None:
    with pytest.raises(CongraspError, match=says):
        drawing(episode(6, removal=4), "3", kind, view, frame, lambda share: None)


FLAGS = np.ones(4, bool)


@pytest.mark.parametrize(
    ("asked", "without", "says"),
    [
        ((), {}, "removed. It guides. Try another heading."),
        (
            ("affordance", "trajectory"),
            {"affordance": 0, "trajectory": 5},
            "The wrist trajectory decided: without it 5 of 8",
        ),
        (("affordance", "pose"), {"affordance": 2, "pose": 1}, "The affordance decided: without it 2 of 8"),
        (("pose",), {"pose": 0}, "does not help. It guides. Try another reference pose."),
        (("affordance", "trajectory"), {"affordance": 0, "trajectory": 0}, "It guides. Try another wrist trajectory."),
        (("affordance",), {"affordance": 0}, "It guides. Try another heading."),
    ],
)
def test_a_failure_names_the_constraint_whose_absence_helps_most(asked, without, says) -> None:
    made = episode(12, removal=8, success=False)
    metrics = {**made.meta["metrics"], "held": 0.0, "diverged": 0.0, "moved_at_removal": 0.2}
    failed = type(made)(made.arrays, {**made.meta, "metrics": metrics})
    request = GraspRequest({"heading": {}, **{name: {} for name in asked}}, FLAGS if "affordance" in asked else None)
    tried: dict[str, GraspRequest] = {}

    def held(weaker: GraspRequest, name: str) -> int:
        tried[name] = weaker
        return without[name]

    note = why_nothing_held(failed, request, ["It guides."], held, attempts=8, drop_height=0.1)
    assert note.startswith("None of 8 attempts held. The one shown: pushed away before the table was removed.")
    assert says in note and tried.keys() == set(asked)
    for name, weaker in tried.items():
        assert set(weaker.constraints) == {"heading", *asked} - {name}
        assert (weaker.avoid is None) == (name == "affordance" or "affordance" not in asked)
