"""The entries of a recording for one episode.

Constant parts of an episode are sent once, at its start; link frames, contacts and signals follow
at each control step.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from congrasp.common.episode.episode import Episode
from congrasp.common.hands.mjcf import WRIST_JOINTS
from congrasp.common.wire.codec import Message, encode
from congrasp.services.record.hand_parts import surface_points
from congrasp.services.record.primitives import point_cloud
from congrasp.services.record.scene import (
    LEAST_FORCE_N,
    contacts,
    link_frame,
    static_scene,
    surface_cloud,
    transforms,
)
from congrasp.services.record.writer import (
    EPISODE_SCHEMA,
    Entry,
    JsonChannels,
    opaque_channel,
    protobuf_channel,
)


def raw_entry(actor: str, message: Message, start: int) -> Entry:
    """Returns the entry with the message of an episode itself.

    Args:
      actor: name of the actor.
      message: the message.
      start: time of the episode's first step, ns.
    """
    channel = opaque_channel(f"{_topic(actor)}/raw", EPISODE_SCHEMA)
    return Entry(channel, start, encode(message))


def scene_entries(
    actor: str, episode: Episode, start: int, slot: int, channels: JsonChannels
) -> Iterator[Entry]:
    """Yields the entries from which viewers draw an episode.

    Args:
      actor: name of the actor, the prefix of topics and frames.
      episode: the episode, recorded by the actor.
      start: time of its first step, ns.
      slot: position of the actor in the row of actors.
      channels: schemas of the JSON signals.

    Raises:
      LookupError, ValueError: a goal array of an active block is missing, or has the wrong shape.
    """
    topic = _topic(actor)
    scene = static_scene(episode, actor, start)
    yield _protobuf(f"{topic}/scene", start, scene, latched=True)
    surface = surface_cloud(episode, actor, start)
    yield _protobuf(f"{topic}/surface", start, surface, latched=True)
    hand = episode.known_hand()
    for link, (points, colours) in zip(hand.links, surface_points(hand), strict=True):
        # Rerun draws point clouds but no scenes; a topic holds one frame's cloud.
        cloud = point_cloud(link_frame(actor, link.name), points, colours, start)
        yield _protobuf(f"{topic}/hand/{link.name}", start, cloud, latched=True)
    step_ns = _step_ns(episode)
    for step in range(episode.steps):
        now = start + step * step_ns
        yield _protobuf(f"{topic}/tf", now, transforms(episode, actor, step, slot, now))
        # Shown until they are replaced, also if the next step is a little late.
        forces = contacts(episode, actor, step, now, 2 * step_ns)
        yield _protobuf(f"{topic}/contacts", now, forces)
        yield channels.entry(f"{topic}/signals", now, _signals(episode, step))


def duration(episode: Episode) -> int:
    """Length of an episode in ns."""
    return _step_ns(episode) * episode.steps


def _topic(actor: str) -> str:
    """Folder of the topics of an actor's episodes."""
    return f"/episode/{actor}"


def _step_ns(episode: Episode) -> int:
    """Length of a control step in ns."""
    return round(1e9 * episode.control_dt)


def _protobuf(topic: str, time: int, message: Any, *, latched: bool = False) -> Entry:
    """Returns an entry of one of Foxglove's messages."""
    kind: Any = type(message)
    return Entry(protobuf_channel(topic, kind, latched=latched), time, message.SerializeToString())


def _signals(episode: Episode, step: int) -> dict[str, Any]:
    """Numbers of one step: time (s), rewards, forces (N), joints (rad; the wrist's slides m), and
    the object's height (m).
    """
    recorded = episode.require_recorded()
    terms = {name: float(values[step]) for name, values in recorded.rewards.items()}
    links = episode.link_names.tolist()
    joints = episode.joint_names.tolist()
    force = np.linalg.norm(episode.link_force[step], axis=-1)
    return {
        "seconds": step * episode.control_dt,
        "reward": {**terms, "total": sum(terms.values())},
        "force": _named(links, force),
        "links_in_contact": int((force > LEAST_FORCE_N).sum()),
        "q": _named(joints, episode.joint_position[step]),
        "q_target": _named(joints, episode.joint_target[step]),
        "wrist": _named(WRIST_JOINTS, recorded.wrist_joints[step]),
        "wrist_target": _named(WRIST_JOINTS, recorded.wrist_targets[step]),
        "object_height": float(episode.object_position[step, 2]),
        "table": bool(episode.table[step]),
    }


def _named(names: Any, numbers: np.ndarray) -> dict[str, float]:
    """Numbers (n,) by n names."""
    return dict(zip(names, map(float, numbers), strict=True))
