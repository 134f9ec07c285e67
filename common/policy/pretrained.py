"""Pretrained policies by hand and name: those of the package, downloaded ones, and the user's,
stored next to the files of custom hands.
"""

import os
import pathlib
from typing import TYPE_CHECKING

from congrasp.common.errors import CongraspError
from congrasp.common.hands import HANDS, get_hand, hands_folder, own_hands
from congrasp.common.io.files import user_folder
from congrasp.common.runtime.lazy_module import LazyModule

if TYPE_CHECKING:
    from congrasp.common.policy import bundle as bundles
else:
    bundles = LazyModule("congrasp.common.policy.bundle")  # imports JAX

FOLDER = pathlib.Path(__file__).with_name("data")
"""Folder of the policies of the package."""
SUFFIX = ".safetensors"
_WITH_REFERENCE = ("human", "allegro", "sharpa")
"""Hands whose reference policy is part of the package."""
_REFERENCE = "-reference"
"""End of the names of policies that the yardstick takes references from."""


def pretrained_file(hand: str) -> pathlib.Path | None:
    """Returns the file of the hand's policy: that of the package, or else the user's; None if there
    is none.

    A hand described by a file can only have a policy of the user, whatever its name.
    """
    spec = get_hand(hand)
    users_file = own_policy_file(spec.name)
    candidates = [users_file] if spec.text else [packaged_file(spec.name), users_file]
    for path in candidates:
        if path.exists():
            return path
    return None


def packaged_file(name: str) -> pathlib.Path:
    """Path of the package's policy of this name, such as `allegro-student`, whether or not it
    exists.
    """
    return FOLDER / f"{name}{SUFFIX}"


def packaged_policies() -> dict[str, pathlib.Path]:
    """Policies of the package by name, without those that only make references."""
    files = _policies_in(FOLDER)
    return {name: file for name, file in files.items() if not name.endswith(_REFERENCE)}


def policies_folder() -> pathlib.Path:
    """Folder of downloaded policies: `CONGRASP_POLICIES`, or congrasp/policies in the user's
    data.
    """
    named = os.environ.get("CONGRASP_POLICIES")
    if named:
        return pathlib.Path(named)
    return user_folder("XDG_DATA_HOME", ".local/share") / "congrasp" / "policies"


def stored_file(name: str) -> pathlib.Path:
    """Path of the downloaded policy of this name, whether or not it exists."""
    return policies_folder() / f"{name}{SUFFIX}"


def stored_policies() -> dict[str, pathlib.Path]:
    """Downloaded policies by name."""
    return _policies_in(policies_folder())


def _policies_in(folder: pathlib.Path) -> dict[str, pathlib.Path]:
    """Policies of a folder by name, in alphabetical order; none if there is no folder."""
    return {file.stem: file for file in sorted(folder.glob(f"*{SUFFIX}"))}


def own_policy_file(name: str) -> pathlib.Path:
    """Path of the user's policy for the hand of this name, whether or not it exists."""
    return hands_folder() / f"{name}{SUFFIX}"


def named_policy(name: str | os.PathLike[str]) -> pathlib.Path:
    """Returns the policy file of this path, or the pretrained or downloaded one of this name
    (`allegro-student`) or hand.

    Raises:
      CongraspError: there is no such hand, or no policy for it.
    """
    path = pathlib.Path(name)
    is_policy = bool(path.suffix or path.exists() or _named(path))
    if str(name) in HANDS or not is_policy:
        return policy_file(None, str(name))
    return policy_file(path)


def _named(name: pathlib.Path) -> pathlib.Path | None:
    """Returns the policy file of this name in the package or among downloaded ones, unless there is
    such a file in the working directory.
    """
    if len(name.parts) != 1 or name.exists():
        return None
    for file in (packaged_file(str(name)), stored_file(str(name))):
        if file.exists():
            return file
    return None


def reference_file(hand: str) -> pathlib.Path | None:
    """Returns the file of a hand's reference policy, without reference poses and trajectories; None
    for a hand whose reference policy is not part of the package, such as a custom hand.

    Raises:
      CongraspError: the file of the package is missing.
    """
    spec = get_hand(hand)
    if spec.text or spec.name not in _WITH_REFERENCE:
        return None
    path = packaged_file(f"{spec.name}{_REFERENCE}")
    if not path.exists():
        raise CongraspError(
            f"{path} is missing: the policy whose grasps are the references of the hand "
            f"'{spec.name}'.",
            "Install congrasp again, or use constraint sets with references of your own "
            "('congrasp constraints generate', 'congrasp evaluate --constraints').",
        )
    return path


def pretrained_hands() -> list[str]:
    """Names of the hands with a policy in the package, in the package's order: the human hand
    first.
    """
    return [name for name in HANDS if packaged_file(name).exists()]


def hands_with_policy() -> list[str]:
    """Names of `pretrained_hands`, followed by the user's custom hands that have a policy."""
    hands = pretrained_hands()
    for name in own_hands():
        if name not in hands and own_policy_file(name).exists():
            hands.append(name)
    return hands


def policy_file(policy: pathlib.Path | None, hand: str = "human") -> pathlib.Path:
    """Returns the policy file of a command: that of a path or name, or else the pretrained one.

    Raises:
      CongraspError: there is no such file, policy or hand, or the user's policy belongs to another
        hand of this name.
    """
    if policy:
        return _named(policy) or policy
    path = pretrained_file(hand)
    spec = get_hand(hand)
    if path is not None and spec.text and bundles.load(path).spec.hand != spec.text:
        raise CongraspError(
            f"{path} was trained for another hand of this name, or for an earlier version of the "
            f"hand's file.",
            "Train it again with 'congrasp hands train', or pass --policy FILE.",
        )
    if path is None:
        raise CongraspError(
            f"No policy was given, and this installation has none for the hand '{spec.name}'.",
            "Train one with 'congrasp hands train', or pass --policy FILE: every run of 'congrasp "
            "train' has a policy.safetensors.",
        )
    return path
