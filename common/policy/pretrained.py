"""Pretrained policies by hand: those of the package, and the user's, stored next to the files of
custom hands.
"""

import os
import pathlib

from congrasp.common.errors import CongraspError
from congrasp.common.hands import HANDS, get_hand, hands_folder, own_hands
from congrasp.common.policy import bundle as bundles

_FOLDER = pathlib.Path(__file__).with_name("data")
SUFFIX = ".safetensors"


def pretrained_file(hand: str) -> pathlib.Path | None:
    """Returns the file of the hand's policy: that of the package, or else the user's; None if there
    is none.

    A hand described by a file can only have a policy of the user, whatever its name.
    """
    found = get_hand(hand)
    packaged, own = _FOLDER / f"{found.name}{SUFFIX}", own_policy_file(found.name)
    return next(
        (path for path in ([own] if found.text else [packaged, own]) if path.exists()), None
    )


def packaged_file(name: str) -> pathlib.Path:
    """Path of the package's policy of this name, such as `allegro-student`, whether or not it
    exists.
    """
    return _FOLDER / f"{name}{SUFFIX}"


def own_policy_file(name: str) -> pathlib.Path:
    """Path of the user's policy for the hand of this name, whether or not it exists."""
    return hands_folder() / f"{name}{SUFFIX}"


def named_policy(name: str | os.PathLike[str]) -> pathlib.Path:
    """Returns the policy file of this path, or the pretrained one of this name (`allegro-student`)
    or hand.

    Raises:
      CongraspError: there is no such hand, or no policy for it.
    """
    path = pathlib.Path(name)
    by_hand = str(name) in HANDS or not (path.suffix or path.exists() or _packaged(path))
    return policy_file(None if by_hand else path, str(name))


def _packaged(name: pathlib.Path) -> pathlib.Path | None:
    """Returns the package's policy file of this name, unless there is such a file in the working
    directory.
    """
    file = _FOLDER / f"{name}{SUFFIX}"
    return file if len(name.parts) == 1 and not name.exists() and file.exists() else None


def reference_file(hand: str) -> pathlib.Path | None:
    """Returns the file of a hand's reference policy, without reference poses and trajectories; None
    if absent.
    """
    path = _FOLDER / f"{get_hand(hand).name}-reference{SUFFIX}"
    return path if path.exists() else None


def pretrained_hands() -> list[str]:
    """Names of the hands with a policy in the package, in the package's order: the human hand
    first.
    """
    return [name for name in HANDS if (_FOLDER / f"{name}{SUFFIX}").exists()]


def hands_with_policy() -> list[str]:
    """Names of `pretrained_hands`, followed by the user's custom hands that have a policy."""
    packaged = pretrained_hands()
    return [
        *packaged,
        *(name for name in own_hands() if name not in packaged and own_policy_file(name).exists()),
    ]


def policy_file(given: pathlib.Path | None, hand: str = "human") -> pathlib.Path:
    """Returns the policy file of a command: the given path or name, or else the pretrained one.

    Raises:
      CongraspError: there is no such file, policy or hand, or the user's policy belongs to another
        hand of this name.
    """
    path = (_packaged(given) or given) if given else pretrained_file(hand)
    if (
        not given
        and path is not None
        and (own := get_hand(hand)).text
        and bundles.load(path).spec.hand != own.text
    ):
        raise CongraspError(
            f"{path} was trained for another hand of this name, or for an earlier version of the "
            f"hand's file.",
            "Train it again with 'congrasp hands train', or pass --policy FILE.",
        )
    if path is None:
        raise CongraspError(
            f"No policy was given, and this installation has none for the hand "
            f"'{get_hand(hand).name}'.",
            "Train one with 'congrasp hands train', or pass --policy FILE: every run of 'congrasp "
            "train' has a "
            "policy.safetensors.",
        )
    return path
