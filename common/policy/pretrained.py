"""Trained policies that come with the package, one for a hand."""

import pathlib

from common.errors import CongraspError
from common.hands import HANDS, get_hand

_FOLDER = pathlib.Path(__file__).with_name("data")


def pretrained_file(hand: str) -> pathlib.Path | None:
    """The file of the policy that comes with the package for this hand; None if none does."""
    path = _FOLDER / f"{get_hand(hand).name}.safetensors"
    return path if path.exists() else None


def reference_file(hand: str) -> pathlib.Path | None:
    """The file of a hand's reference policy, which knows no reference poses and no trajectories; None if none comes."""
    path = _FOLDER / f"{get_hand(hand).name}-reference.safetensors"
    return path if path.exists() else None


def pretrained_hands() -> list[str]:
    """Names of the hands whose policies come with the package, in the package's order: the human hand is the first."""
    return [name for name in HANDS if (_FOLDER / f"{name}.safetensors").exists()]


def policy_file(given: pathlib.Path | None, hand: str = "human") -> pathlib.Path:
    """The policy file that a command was given, or the pretrained one for this hand.

    Raises:
      CongraspError: neither is there, or there is no such hand.
    """
    path = given or pretrained_file(hand)
    if path is None:
        raise CongraspError(
            f"No policy was named, and none comes with this installation for the hand '{get_hand(hand).name}'.",
            "Give --policy FILE: every run of 'congrasp train' has a policy.safetensors.",
        )
    return path
