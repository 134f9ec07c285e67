"""Motions as the page shows and saves them: lanes, pictures, videos, and why nothing held."""

import dataclasses
import io
import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.request import GraspRequest
from congrasp.common.task.constraints import get_constraint
from congrasp.common.wire.codec import Message, decode, encode
from congrasp.services.studio.grasping import why_nothing_held
from congrasp.services.studio.page import drawing, for_page, lanes
from tests.episodes import episode, older

STEPS = 30
REMOVAL = 18
TOLERANCES = {}
for _name in ("heading", "trajectory"):
    for _error in get_constraint(_name).errors:
        TOLERANCES[_name, _error.unit] = _error.tolerance


def with_error(made: Episode, **values: float | np.ndarray) -> Message:
    """The episode with other errors in all steps."""
    recorded = made.require_recorded()
    errors = dict(recorded.errors)
    for name, value in values.items():
        errors[name] = np.broadcast_to(np.float32(value), STEPS)
    return dataclasses.replace(made, recorded=dataclasses.replace(recorded, errors=errors))


def test_every_active_constraint_has_a_lane_and_no_other() -> None:
    assert set(lanes(episode(STEPS, removal=REMOVAL))) == {
        "contact",
        "heading",
        "affordance",
        "pose",
        "trajectory",
    }
    assert set(lanes(episode(STEPS, removal=REMOVAL, mask=(0, 0, 0, 0)))) == {
        "contact",
        "heading",
    }


def test_the_fake_grasp_meets_its_constraints() -> None:
    shown_lanes = lanes(episode(STEPS, removal=REMOVAL, mask=(0, 1, 1, 1)))
    heading = shown_lanes["heading"]
    np.testing.assert_allclose(heading.errors["rad"], 0.0, atol=1e-3)
    assert heading.met[-1]
    assert heading.counts.tolist() == [False] * REMOVAL + [True] * (STEPS - REMOVAL)
    pose = shown_lanes["pose"]
    assert pose.errors["rad"][-1] == pytest.approx(0.0, abs=1e-6)
    assert pose.errors["m"][-1] == pytest.approx(0, abs=1e-6)
    assert not pose.met[0]
    assert pose.met[-1]
    trajectory = shown_lanes["trajectory"]
    assert trajectory.counts.tolist() == [True] * REMOVAL + [False] * (STEPS - REMOVAL)
    np.testing.assert_allclose(trajectory.errors["m"], 0.0, atol=1e-6)
    assert trajectory.met.all()


def test_with_a_lift_contact_counts_from_the_lift_on() -> None:
    recorded = episode(STEPS, removal=REMOVAL)
    about = {**recorded.about, "phases": {"grasp": 0.0, "lift": 0.2, "hold": 0.25}}
    lifted = lanes(dataclasses.replace(recorded, table=np.ones(STEPS, bool), about=about))
    assert lifted["contact"].counts.tolist() == [False] * 20 + [True] * (STEPS - 20)
    assert lifted["trajectory"].counts.tolist() == [True] * 20 + [False] * (STEPS - 20)


@pytest.mark.parametrize("name", ["heading", "trajectory"])
@pytest.mark.parametrize("unit", ["rad", "m"])
def test_an_error_above_its_tolerance_breaks_its_lane(name: str, unit: str) -> None:
    recorded = episode(STEPS, removal=REMOVAL)
    most = TOLERANCES[name, unit]
    lane = lanes(with_error(recorded, **{f"{name}_{unit}": most + 0.001}))[name]
    np.testing.assert_allclose(lane.errors[unit], most + 0.001, atol=1e-6)
    assert not lane.met.any()
    assert lanes(with_error(recorded, **{f"{name}_{unit}": most - 0.001}))[name].met.any()


def test_only_links_that_press_on_the_paint_break_the_affordance() -> None:
    recorded = episode(STEPS, removal=REMOVAL)
    assert lanes(recorded)["affordance"].met.all()
    touching = np.linalg.norm(recorded.link_force, axis=-1).max(-1) > 0.05
    lane = lanes(with_error(recorded, affordance_ratio=np.where(touching, 0.2, 0.0)))["affordance"]
    np.testing.assert_array_equal(lane.met, ~touching)
    assert lane.errors["share"][-1] == pytest.approx(0.2)


def test_only_the_fingers_of_a_pose_count_under_a_wrist_path() -> None:
    recorded = with_error(episode(STEPS, removal=REMOVAL, mask=(0, 1, 0, 1)), pose_m=0.2)
    pose = lanes(recorded)["pose"]
    assert pose.met[-1]
    assert set(pose.errors) == {"rad"}
    assert "distance" not in pose.legend


def test_every_constraint_with_recorded_errors_has_a_lane() -> None:
    recorded = with_error(episode(STEPS, removal=REMOVAL, mask=(0, 0, 0, 0)), fingers_ratio=0.25)
    message = recorded.to_message()
    arrays = {**message.arrays, "active/fingers": np.bool_(True)}
    lane = lanes(Episode.from_message(Message(arrays, message.meta)))["fingers"]
    assert not lane.met.any()
    assert lane.legend == "share of touching links of other fingers: 0 % at most"


def test_the_page_gets_one_message_with_everything_it_plays() -> None:
    message = decode(encode(for_page(episode(STEPS, removal=REMOVAL))))
    assert message.arrays["lane/heading/met"].shape == (STEPS,)
    assert "at most" in message.meta["lanes"]["heading"]
    assert {
        "link_position",
        "object_quaternion",
        "reward/contact",
        "arrow/heading/tip",
    } <= message.arrays.keys()
    # The fake grasp ends in its reference pose: the ghost is where the hand is, in the object's
    # frame.
    last = message.arrays["link_position"][-1] - message.arrays["object_position"][-1]
    np.testing.assert_allclose(message.arrays["ghost/pose/position"], last, atol=1e-5)


def test_an_older_recording_has_its_markers_and_only_the_lane_of_contact() -> None:
    current = episode(STEPS, removal=REMOVAL, mask=(1, 1, 0, 1))
    recorded = Episode.from_message(older(current.to_message()))
    shown_lanes = lanes(recorded)
    assert set(shown_lanes) == {"contact"}
    np.testing.assert_array_equal(shown_lanes["contact"].met, lanes(current)["contact"].met)
    page = for_page(recorded)
    now = for_page(current)
    kinds = ("arrow/", "polyline/", "ghost/", "paint/")
    drawn = {name: array for name, array in now.arrays.items() if name.startswith(kinds)}
    assert drawn.keys() == {name for name in page.arrays if name.startswith(kinds)}
    for name, array in drawn.items():
        np.testing.assert_array_equal(page.arrays[name], array)


VIEW = {"position": [0.5, -0.6, 0.4], "target": [0.0, 0.0, 0.06], "field_of_view": 32.0}


def image(view: dict[str, object], frame: int = 5) -> np.ndarray:
    picture = drawing(episode(6, removal=4), "3", "png", view, frame, lambda share: None)
    assert picture.name == f"cylinder-0-3-{frame}.png"
    return np.asarray(Image.open(io.BytesIO(picture.data))).astype(int)


def painted(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the object's pixels: the affordance paints it red and green."""
    red = seen[..., 0]
    green = seen[..., 1]
    blue = seen[..., 2]
    return np.nonzero(
        ((red > 2 * green) & (red > 2 * blue)) | ((green > 1.5 * red) & (green > 1.5 * blue))
    )


def test_a_picture_has_the_camera_of_the_page() -> None:
    seen = image(VIEW)
    rows, columns = painted(seen)
    assert seen.shape == (720, 1280, 3)
    assert abs(np.median(columns) - 640) < 40
    # From twice as far the object is half as large along each side.
    assert len(painted(image({**VIEW, "position": [1.0, -1.2, 0.74]}))[0]) == pytest.approx(
        len(rows) / 4, rel=0.25
    )


def test_a_video_has_a_frame_for_every_40_ms() -> None:
    shares: list[float] = []
    video = drawing(episode(6, removal=4), "3", "mp4", VIEW, 0, shares.append)
    assert video.name == "cylinder-0-3.mp4"
    assert shares[-1] == 1.0
    assert shares == sorted(shares)
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-i",
        "-",
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    frames = subprocess.run(command, input=video.data, capture_output=True, check=True).stdout
    assert len(frames) == len(shares) * 854 * 480 * 3
    assert len(shares) == 2  # steps 0 and 4


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
        (
            ("affordance", "pose"),
            {"affordance": 2, "pose": 1},
            "The affordance decided: without it 2 of 8",
        ),
        (("pose",), {"pose": 0}, "does not help. It guides. Try another reference pose."),
        (
            ("affordance", "trajectory"),
            {"affordance": 0, "trajectory": 0},
            "It guides. Try another wrist trajectory.",
        ),
        (("affordance",), {"affordance": 0}, "It guides. Try another heading."),
    ],
)
def test_a_failure_names_the_constraint_whose_absence_helps_most(asked, without, says) -> None:
    made = episode(12, removal=8, success=False)
    metrics = {**made.metrics, "held": 0.0, "diverged": 0.0, "moved_at_removal": 0.2}
    failed = dataclasses.replace(made, metrics=metrics)
    request = GraspRequest(
        {"heading": {}, **{name: {} for name in asked}}, FLAGS if "affordance" in asked else None
    )
    tried: dict[str, GraspRequest] = {}

    def held(weaker: GraspRequest, name: str) -> int:
        tried[name] = weaker
        return without[name]

    note = why_nothing_held(failed, request, ["It guides."], held, attempts=8, drop_height=0.1)
    assert note.startswith(
        "None of 8 attempts held. The one shown: pushed away before the table was removed."
    )
    assert says in note
    assert tried.keys() == set(asked)
    for name, weaker in tried.items():
        assert set(weaker.constraints) == {"heading", *asked} - {name}
        assert (weaker.avoid is None) == (name == "affordance" or "affordance" not in asked)
