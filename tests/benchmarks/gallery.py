"""The gallery of docs/gallery: grasps of scanned and generated objects under each constraint, by
three hands.
"""

import pathlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from congrasp.actors.attempts import Phases
from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import policy_file
from congrasp.common.runtime.progress import ignore_progress
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.grasp.files import RECORDING
from congrasp.services.grasp.grasper import Grasper
from congrasp.services.grasp.jobs import Settings, find_objects, grasp_object
from congrasp.services.grasp.result import Result
from congrasp.services.record.reader import pick_episode
from congrasp.services.viz.film import Film, film_frames
from congrasp.services.viz.render import render_episode_frames
from tests.pictures import provenance

_SIZE = (480, 360)  # pixels
_QUALITY = 88  # of JPEG
_FILM_SIZE = (400, 300)  # pixels
_FILM_FPS = 12.5
_COLOURS = 256  # of a film
_PHASES = Phases(approach=0.7, lift=0.12)
_HEAD = """# Gallery

<!-- not run: needs scans that do not ship; tests/docs/test_page_grasps.py repeats the grasps -->
```sh
python -m tests.benchmarks gallery --scans object_sim    # these grasps, pictures and this page
```

Each picture is the end of the hold, after a reach from the side of the table and a lift. The scans are from MyoSuite
(Apache-2.0, `simhive/object_sim`). The command writes the grasps to `runs/gallery`, and uses two of them as references of other grasps.
The policies are {policies}.

| grasp | command, and number of attempts that hold the object |
|---|---|
"""
_DIGITS = 16
"""Digits of a policy's hash on the page."""


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
    Shown(
        "mug",
        "examples/mug.obj",
        rest="upright",
        options={"affordance": "examples/handle.obj"},
        film=True,
    ),
    Shown("drill", "drill:2", options={"affordance": "grip"}),
    Shown("wine-glass", "wineglass", rest="upright"),
    Shown("water-bottle", "waterbottle", rest="upright"),
    Shown("hammer", "hammer", options={"heading": "above"}),
    Shown("banana", "banana", options={"heading": "above"}),
    Shown("light-bulb", "lightbulb", options={"gentle": True}),
    Shown("apple", "apple", options={"fingers": "thumb index middle"}, film=True),
    Shown("camera", "camera"),
    Shown("binoculars", "binoculars", options={"heading": "above"}),
    Shown("rubber-duck", "duck"),
    Shown("elephant", "elephant", options={"heading": "above"}),
    Shown("flashlight", "flashlight"),
    Shown("stapler", "stapler", options={"force": "5"}),
    Shown("coffee-mug", "coffeemug", rest="upright"),
    Shown("hollow-mug", "hollow_mug:7", options={"affordance": "handle"}),
    Shown(
        "bottle-pose",
        "waterbottle",
        options={"pose": "{out}/water-bottle/waterbottle/grasp.npz"},
        rest="upright",
    ),
    Shown(
        "bulb-path",
        "lightbulb",
        options={
            "trajectory": "{out}/light-bulb/lightbulb/grasp.npz",
            "fingers": "thumb index middle",
        },
    ),
    Shown("allegro-bottle", "waterbottle", "allegro", rest="upright"),
    Shown("allegro-mug", "coffeemug", "allegro", rest="upright"),
    Shown("allegro-hammer", "hammer", "allegro", options={"heading": "above"}, film=True),
    Shown("sharpa-duck", "duck", "sharpa"),
    Shown("sharpa-ring", "torusmedium", "sharpa"),
    Shown("sharpa-camera", "camera", "sharpa", options={"heading": "above"}),
)


def gallery(
    scans: pathlib.Path,
    work: pathlib.Path = pathlib.Path("runs/gallery"),
    out: pathlib.Path = pathlib.Path("docs/gallery"),
    attempts: int = 16,
) -> int:
    """Grasps of 24 objects as a page with pictures and short films.

    Args:
      scans: Folder of the scanned objects; the others come with the repository.
      work: Folder for the grasps; those that are finished in it are drawn again, not made again.
      out: Folder for page and pictures.
      attempts: Grasps that are simulated side by side, for each object.

    Examples:
      python -m tests.benchmarks gallery --scans my-objects
      python -m tests.benchmarks gallery --scans my-objects --out pictures
    """
    results = []
    for result in _results(scans, work, out, attempts):
        print(f"{result.name}: {result.line()}", flush=True)
        results.append(result)
    return 0 if all(result.held for result in results) else 1


def _results(
    scans: pathlib.Path, work: pathlib.Path, out: pathlib.Path, attempts: int
) -> Iterator[Result]:
    """Grasps what is not finished in `work`, and draws pictures, films and the page in `out`;
    yields each result.
    """
    graspers: dict[str, Grasper] = {}
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for entry in SHOWN:
        file = policy_file(None, entry.hand)
        if entry.hand not in graspers:
            graspers[entry.hand] = Grasper(bundles.load(file), attempts=attempts, phases=_PHASES)
        path = scans / entry.object
        (at,), errors = find_objects([str(path) if path.exists() else entry.object])
        if errors:
            raise CongraspError(errors[0].error)
        settings = Settings(
            out=work / entry.name,
            options=ImportOptions("guess"),
            constraints={name: _given(value, work) for name, value in entry.options.items()},
            film=None,
            view=None,
            pictures=False,
            again=False,
            rest=entry.rest,
        )
        result = grasp_object(at, graspers[entry.hand], settings, ignore_progress)
        yield result._replace(name=entry.name)
        if result.error:
            continue
        episode = pick_episode(settings.out / at.name / RECORDING, -1, success=False)
        portrait = out / f"{entry.name}.jpg"
        save_portrait(portrait, episode)
        origin = provenance.current(command_of(entry), (entry.hand,), rendered=True)
        provenance.write(portrait, origin)
        if entry.film:
            film = out / f"{entry.name}.gif"
            save_film(film, episode)
            provenance.write(film, origin)
        claim = (
            f"{result.facts['attempts_held']} of {result.facts['attempts']}, "
            f"resting pose {result.facts['rest']}"
        )
        rows.append(f"| ![{entry.name}]({entry.name}.jpg) | `{command_of(entry)}`<br>{claim} |\n")
    (out / "index.md").write_text(_HEAD.format(policies=_policies()) + "".join(rows))
    for grasper in graspers.values():
        grasper.close()


def _policies() -> str:
    """Hands and hashes of the policies that ship, for the page."""
    hands = dict.fromkeys(entry.hand for entry in SHOWN)
    hashes = {hand: bundles.load(policy_file(None, hand)).actor_sha256 for hand in hands}
    return ", ".join(f"`{hand}` {digest[:_DIGITS]}" for hand, digest in hashes.items())


def _given(value: Any, work: pathlib.Path) -> Any:
    """The value of an option, with the gallery's working folder in it."""
    return value.format(out=work) if isinstance(value, str) else value


def command_of(entry: Shown) -> str:
    """The command that makes the grasp."""
    is_scan = ":" not in entry.object and "/" not in entry.object
    words = ["congrasp grasp", f"object_sim/{entry.object}" if is_scan else entry.object]
    options = {"hand": entry.hand, "rest": entry.rest, **entry.options}
    for name, value in options.items():
        if not value or (name, value) == ("hand", "human"):
            continue
        words.append(f"--{name}")
        if value is not True:
            words.append(str(_given(value, pathlib.Path("runs/gallery"))))
    return " ".join([*words, f"--approach {_PHASES.approach:g} --lift {_PHASES.lift:g}"])


def save_portrait(path: pathlib.Path, episode: Episode) -> None:
    """Writes the last step of a motion as JPEG."""
    last = episode.steps - 1
    (picture,) = render_episode_frames(episode, [last], _SIZE, overlays=False)
    Image.fromarray(picture).save(path, quality=_QUALITY)


def save_film(path: pathlib.Path, episode: Episode) -> None:
    """Writes a motion as an animated GIF, in real time, to the end of its hold."""
    frames = list(film_frames(episode, Film(_FILM_SIZE, _FILM_FPS)))
    several = np.hstack(frames[:: max(1, len(frames) // 8)])
    palette = Image.fromarray(several).quantize(_COLOURS, dither=Image.Dither.NONE)
    drawn = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    drawn[0].save(
        path, save_all=True, append_images=drawn[1:], duration=round(1000 / _FILM_FPS), loop=0
    )
