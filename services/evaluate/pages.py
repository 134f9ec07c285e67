"""HTML pages about policies: templates, pictures in them, and curves of a training."""

import base64
import collections
import dataclasses
import functools
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from congrasp.common.errors import need_package
from congrasp.services.record.reader import read_metrics
from congrasp.services.viz.plots import draw, encoded, figures

_TEMPLATES = pathlib.Path(__file__).parent


@dataclasses.dataclass(frozen=True)
class Picture:
    """A picture of a page."""

    title: str
    png: bytes
    caption: str = ""


@functools.cache
def template(path: pathlib.Path) -> Any:
    """Returns a page template, which may extend `base.html`; raises a CongraspError if jinja2 is
    not installed.
    """
    need_package("A report", "jinja2")
    import jinja2

    loader = jinja2.FileSystemLoader([path.parent, _TEMPLATES])
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, loader=loader
    )
    return environment.get_template(path.name)


def curves_of(run_dir: pathlib.Path) -> Iterator[Picture]:
    """Yields the figures of a run's recordings, if it has any."""
    if any(run_dir.rglob("*.mcap")):
        runs = {run_dir.name: read_metrics(run_dir)}
        for title, panels in figures(runs).values():
            yield Picture(title, encoded(draw(title, panels, runs)))


def count_causes(causes: Sequence[str]) -> str:
    """Counts causes, such as "2 held, 1 slipped 0.82 s after the table was removed"."""
    return ", ".join(f"{count} {cause}" for cause, count in collections.Counter(causes).items())


def embed(picture: Picture) -> Mapping[str, Any]:
    """Picture for the template."""
    return {
        "title": picture.title,
        "caption": picture.caption,
        "image": base64.b64encode(picture.png).decode(),
    }
