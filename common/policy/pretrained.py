"""Trained policies by their hands: those that come with the package, and the user's own beside the own hands' files."""

import os
import pathlib

from congrasp.common.errors import CongraspError
from congrasp.common.hands import HANDS, get_hand, hands_folder, own_hands
from congrasp.common.policy import bundle as bundles

_FOLDER = pathlib.Path(__file__).with_name("data")
SUFFIX = ".safetensors"


def pretrained_file(hand: str) -> pathlib.Path | None:
    """The file of the policy for this hand that comes with the package, or else the user's own; None if there is none.

    A hand that is described by a file has a policy of the user's own alone, whatever its name.
    """
    found = get_hand(hand)
    packaged, own = _FOLDER / f"{found.name}{SUFFIX}", own_policy_file(found.name)
    return next((path for path in ([own] if found.text else [packaged, own]) if path.exists()), None)


def own_policy_file(name: str) -> pathlib.Path:
    """Where the user's own policy for the hand of this name is, or would be."""
    return hands_folder() / f"{name}{SUFFIX}"


def named_policy(name: str | os.PathLike[str]) -> pathlib.Path:
    """The policy file of this path, or the pretrained one of this name (`allegro-student`) or of this hand.

    Raises:
      CongraspError: there is no such hand, or no policy for it.
    """
    path = pathlib.Path(name)
    by_hand = str(name) in HANDS or not (path.suffix or path.exists() or _packaged(path))
    return policy_file(None if by_hand else path, str(name))


def _packaged(name: pathlib.Path) -> pathlib.Path | None:
    """The policy file of this name that comes with the package, unless a file here has that name."""
    file = _FOLDER / f"{name}{SUFFIX}"
    return file if len(name.parts) == 1 and not name.exists() and file.exists() else None


def reference_file(hand: str) -> pathlib.Path | None:
    """The file of a hand's reference policy, which knows no reference poses and no trajectories; None if none comes."""
    path = _FOLDER / f"{get_hand(hand).name}-reference{SUFFIX}"
    return path if path.exists() else None


def pretrained_hands() -> list[str]:
    """Names of the hands whose policies come with the package, in the package's order: the human hand is the first."""
    return [name for name in HANDS if (_FOLDER / f"{name}{SUFFIX}").exists()]


def hands_with_policy() -> list[str]:
    """The same, and then the names of the user's own hands that have a policy."""
    packaged = pretrained_hands()
    return [*packaged, *(name for name in own_hands() if name not in packaged and own_policy_file(name).exists())]


def policy_file(given: pathlib.Path | None, hand: str = "human") -> pathlib.Path:
    """The policy file that a command was given, by path or by a name in the package, or else the pretrained one.

    Raises:
      CongraspError: neither is there, there is no such hand, or the user's own policy is of another hand of its name.
    """
    path = (_packaged(given) or given) if given else pretrained_file(hand)
    if not given and path is not None and (own := get_hand(hand)).text and bundles.load(path).spec.hand != own.text:
        raise CongraspError(
            f"{path} was trained for another hand of this name, or before the hand's file was changed.",
            "Train it again with 'congrasp hands train', or give --policy FILE.",
        )
    if path is None:
        raise CongraspError(
            f"No policy was named, and none comes with this installation for the hand '{get_hand(hand).name}'.",
            "Train one with 'congrasp hands train', or give --policy FILE: every run of 'congrasp train' has a "
            "policy.safetensors.",
        )
    return path
