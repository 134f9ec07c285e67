"""A layout for Foxglove that fits a recording: its actors in 3-D, its learning curves, its
events.
"""

import pathlib
from collections.abc import Sequence

import foxglove.layouts as fl

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import parse_json
from congrasp.services.record.reader import log_files, metrics_of, read_records
from congrasp.services.record.writer import flatten

CURVES = {
    "Success and return": ("episode/success", "episode/return"),
    "Throughput": ("steps_per_second",),
    "Staleness": ("staleness_mean", "staleness_max"),
    "Losses": ("policy_loss", "value_loss", "kl"),
}
"""Plots of a learner's metrics; those that the recording lacks are omitted."""
SIGNALS = {
    "Reward": ("reward.total", "reward.contact", "reward.distance"),
    "Contact": ("links_in_contact", "object_height"),
}
"""Plots of an actor's episodes, by the fields of `signals`."""
_LOOKED_AT = ("/episode/", "/metrics/learner/", "/events/")
_SHOWN = ("scene", "contacts")
_ACTORS = 4
"""Actors whose scenes are shown initially; the others can be enabled."""


def export_layout(recording: pathlib.Path, path: pathlib.Path) -> int:
    """Writes a layout for a recording, to be opened with Foxglove's "Import from file".

    Returns:
      The number of panels.

    Raises:
      CongraspError: there is nothing to show in the recording.
    """
    actors: dict[str, set[str]] = {}
    metrics: dict[str, set[str]] = {}
    events = ""
    for file in log_files(recording):
        for record in read_records(file, lambda topic: topic.startswith(_LOOKED_AT)):
            kind, *rest = record.topic.strip("/").split("/")
            if kind == "episode":
                fields = actors.setdefault(rest[0], set())
                if rest[1] == "signals":
                    fields |= set(flatten(parse_json(record.data, "A recording's signals")))
            elif kind == "metrics":
                metrics.setdefault(record.topic, set()).update(
                    flatten(metrics_of(record)["values"])
                )
            else:
                events = events or record.topic
    if not (actors or metrics):
        raise CongraspError(
            f"The recordings in {recording} hold neither episodes nor metrics of a learner."
        )
    columns = []
    if actors:
        first = min(actors)
        shown = {
            title: [f for f in fields if f.replace(".", "/") in actors[first]]
            for title, fields in SIGNALS.items()
        }
        plots = [
            _plot(t, [f"/episode/{first}/signals.{field}" for field in fields])
            for t, fields in shown.items()
        ]
        columns.append(
            _split(
                "column", [(3.0, _scene(sorted(actors))), *((1.0, plot) for plot in plots if plot)]
            )
        )
    right: list[tuple[float, fl.Content]] = []
    for title, names in CURVES.items():
        found = [
            (topic, name) for topic, known in metrics.items() for name in names if name in known
        ]
        if plot := _plot(
            title, [f"{topic}.values.{name.replace('/', '.')}" for topic, name in found]
        ):
            right.append((1.0, plot))
    if events:
        right.append(
            (1.0, fl.LogPanel(title="Events", config=fl.LogConfig(topic_to_render=events)))
        )
    if right:
        columns.append(_split("column", right))
    layout = fl.Layout(content=_split("row", [(1.0, column) for column in columns]))
    text = layout.to_json()
    write_atomically(path, text.encode())
    return text.count('"panelType"')


def _plot(title: str, paths: Sequence[str]) -> fl.PlotPanel | None:
    """A plot of some paths, if there are any."""
    series = [
        fl.PlotSeries(value=path, label=path.rpartition(".")[2], enabled=True) for path in paths
    ]
    return (
        fl.PlotPanel(title=title, config=fl.PlotConfig(paths=series, show_legend=True))
        if series
        else None
    )


def _scene(actors: Sequence[str]) -> fl.ThreeDeePanel:
    """The 3-D panel with the actors' scenes."""
    topics = {
        f"/episode/{actor}/{part}": fl.BaseRendererSceneUpdateTopicSettings(
            visible=number < _ACTORS
        )
        for number, actor in enumerate(actors)
        for part in _SHOWN
    }
    frames = fl.BaseRendererTransforms(visible=False, show_label=False)
    camera = fl.ThreeDeeCameraState(
        distance=0.8, phi=65.0, theta_offset=45.0, target=(0.0, 0.0, 0.1), near=0.01
    )
    config = fl.ThreeDeeConfig(
        camera_state=camera,
        fixed_frame="world",
        follow_mode="follow-none",
        scene=fl.BaseRendererSceneSettings(transforms=frames),
        topics=dict(topics),
    )
    return fl.ThreeDeePanel(title="Episodes", config=config)


def _split(direction: str, items: Sequence[tuple[float, fl.Content]]) -> fl.Content:
    """Arranges panels horizontally or vertically, with their shares of the space."""
    kept = [fl.SplitItem(proportion=share, content=content) for share, content in items]
    return fl.SplitContainer(direction="row" if direction == "row" else "column", items=kept)
