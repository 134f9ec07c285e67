"""The gallery of docs/gallery: grasps of scanned and made-up objects under each constraint, by three hands."""

import pathlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import policy_file
from congrasp.common.wire.codec import Message
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.grasp.files import MOTION, RECORDING
from congrasp.services.grasp.grasper import Grasper
from congrasp.services.grasp.jobs import Result, Settings, find_objects, grasp_object
from congrasp.services.record.reader import pick_episode
from congrasp.services.viz.render import grasp_steps, render_episode_frames
from congrasp.services.viz.sheets import contact_sheet, save_png
from congrasp.services.viz.views import camera_of, views

_SIZE, _COLUMNS = (320, 240), 6
_FILM_SIZE, _FILM_FPS, _HELD = (320, 240), 12.5, 0.5  # pixels, frames a second, s of the hold
_COLOURS = 224  # of a film
_APPROACH, _LIFT = 1.0, 0.12  # s, m


class Shown(NamedTuple):
    """A grasp of the gallery."""

    name: str
    """Of its folder, and of the picture."""
    object: str
    """A name in the folder of scans, FAMILY:SEED of the generator, or a file of the repository."""
    hand: str = "human"
    options: dict[str, Any] = {}  # noqa: RUF012  read only
    """Constraints, as the command line has them; `{out}` is the gallery's working folder."""
    rest: str = ""
    film: bool = False


SHOWN = (
    Shown("mug", "examples/mug.obj", options={"affordance": "examples/handle.obj"}, film=True),
    Shown("teapot", "teapot"),
    Shown("wine-glass", "wineglass", rest="upright"),
    Shown("water-bottle", "waterbottle", rest="upright", film=True),
    Shown("hammer", "hammer", options={"heading": "above"}),
    Shown("banana", "banana", options={"heading": "above"}),
    Shown("light-bulb", "lightbulb", options={"gentle": True}),
    Shown("apple", "apple", options={"fingers": "thumb index middle"}),
    Shown("camera", "camera"),
    Shown("binoculars", "binoculars", options={"heading": "above"}),
    Shown("rubber-duck", "duck"),
    Shown("elephant", "elephant", options={"heading": "above"}),
    Shown("flashlight", "flashlight"),
    Shown("stapler", "stapler", options={"force": "5"}),
    Shown("coffee-mug", "coffeemug", rest="upright"),
    Shown("mug-7", "mug:7", options={"affordance": "handle"}, rest="upright"),
    Shown("bottle-pose", "waterbottle", options={"pose": "{out}/water-bottle/waterbottle/grasp.npz"}, rest="upright"),
    Shown("bulb-path", "lightbulb", options={"trajectory": "{out}/light-bulb/lightbulb/grasp.npz"}),
    Shown("allegro-bottle", "waterbottle", "allegro", rest="upright"),
    Shown("allegro-teapot", "teapot", "allegro"),
    Shown("allegro-hammer", "hammer", "allegro", options={"heading": "above"}, film=True),
    Shown("sharpa-duck", "duck", "sharpa"),
    Shown("sharpa-ring", "torusmedium", "sharpa"),
    Shown("sharpa-camera", "camera", "sharpa", options={"heading": "above"}),
)


def make_gallery(scans: pathlib.Path, work: pathlib.Path, out: pathlib.Path, attempts: int) -> Iterator[Result]:
    """Grasps what is not finished in `work`, and draws the sheet and the films in `out`; yields each result."""
    graspers: dict[str, Grasper] = {}
    tiles, labels = [], []
    for shown in SHOWN:
        file = policy_file(None, shown.hand)
        if shown.hand not in graspers:
            graspers[shown.hand] = Grasper(bundles.load(file), attempts=attempts, approach=_APPROACH, lift=_LIFT)
        path = pathlib.Path(shown.object)
        (at,), errors = find_objects([scans / shown.object if (scans / shown.object).exists() else path])
        if errors:
            raise CongraspError(errors[0].error)
        given = {
            name: value.format(out=work) if isinstance(value, str) else value for name, value in shown.options.items()
        }
        identity = bundles.content_hash(file.read_bytes()), attempts, _APPROACH, _LIFT
        settings = Settings(
            out=work / shown.name,
            options=ImportOptions("guess"),
            constraints=given,
            identity=identity,
            film=None,
            view=None,
            pictures=False,
            again=False,
            rest=shown.rest,
        )
        result = grasp_object(at, graspers[shown.hand], settings, lambda what, done, total: None)
        yield result._replace(name=shown.name)
        if result.error:
            continue
        folder = settings.out / at.name
        assert (folder / MOTION).is_file()
        episode = pick_episode(folder / RECORDING, -1, success=False)
        last = len(episode.arrays["table"]) - 1
        tiles += render_episode_frames(episode, [last], _SIZE, overlays=False)
        words = " ".join(f"{name} {value}" for name, value in shown.options.items() if name in ("heading", "fingers"))
        words = words or " ".join(shown.options)
        verdict = "" if result.held else ": NOT HELD"
        labels.append(", ".join([f"{shown.hand}: {at.name}", *([words] if words else [])]) + verdict)
        if shown.film:
            save_film(out / f"{shown.name}.gif", episode)
    save_png(out / "gallery.png", contact_sheet(tiles, labels, columns=_COLUMNS))
    for grasper in graspers.values():
        grasper.close()


def save_film(path: pathlib.Path, episode: Message) -> None:
    """Writes a motion as an animated GIF, in real time, up to half a second of its hold."""
    dt = float(episode.meta["control_dt"])
    hold = float(episode.meta["phases"]["hold"])
    steps = np.arange(0.0, hold + _HELD, 1 / _FILM_FPS) / dt
    steps = [int(step) for step in steps if step < len(episode.arrays["table"])]
    view = views(episode, [grasp_steps(episode)[1], steps[-1]])[0]
    camera = camera_of(episode, steps, _FILM_SIZE[0] / _FILM_SIZE[1], view)
    frames = [
        Image.fromarray(frame) for frame in render_episode_frames(episode, steps, _FILM_SIZE, camera, overlays=False)
    ]
    several = np.hstack([np.asarray(frame) for frame in frames[:: max(1, len(frames) // 4)]])
    palette = Image.fromarray(several).quantize(_COLOURS, dither=Image.Dither.NONE)
    drawn = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn[0].save(path, save_all=True, append_images=drawn[1:], duration=round(1000 / _FILM_FPS), loop=0)
