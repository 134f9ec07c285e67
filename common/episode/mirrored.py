"""The mirror image of an episode: that of the other hand with the mirrored object."""

import dataclasses
from typing import Any

from congrasp.common import mirror
from congrasp.common.episode.episode import Episode, Recorded
from congrasp.common.episode.hand_arrays import hand_arrays
from congrasp.common.hands.spec import Hand


def mirrored_episode(episode: Episode, hand: Hand) -> Episode:
    """Returns the mirror image of a recorded episode, at the plane x = 0 of the world and of every
    frame (`common.mirror`). An arm is not mirrored.

    Args:
      episode: the episode.
      hand: the mirror image of its hand.

    Raises:
      CongraspError: the episode is that of a motion file.
    """
    colours = episode.colours
    if colours:
        colours = colours._replace(points=mirror.vector(colours.points))
    of_hand: dict[str, Any] = hand_arrays(hand)
    return dataclasses.replace(
        episode,
        hand=hand.name,
        **of_hand,
        link_position=mirror.vector(episode.link_position),
        link_quaternion=mirror.quaternion(episode.link_quaternion),
        link_force=mirror.vector(episode.link_force),
        object_position=mirror.vector(episode.object_position),
        object_quaternion=mirror.quaternion(episode.object_quaternion),
        object_vertices=mirror.vector(episode.object_vertices),
        object_faces=episode.object_faces[:, ::-1],
        object_file_origin=mirror.vector(episode.object_file_origin),
        surface_points=mirror.vector(episode.surface_points),
        colours=colours,
        goal=mirror.fields(episode.goal),
        recorded=_mirrored_recorded(episode.require_recorded(), hand),
    )


def _mirrored_recorded(recorded: Recorded, hand: Hand) -> Recorded:
    """Returns the mirror image of the content that motion files lack."""
    pieces = recorded.pieces
    return dataclasses.replace(
        recorded,
        hand_reference=hand.reference,
        wrist_joints=mirror.wrist(recorded.wrist_joints),
        wrist_targets=mirror.wrist(recorded.wrist_targets),
        action=mirror.wrist(recorded.action),
        pieces=pieces._replace(pos=mirror.vector(pieces.pos), quat=mirror.quaternion(pieces.quat)),
    )
