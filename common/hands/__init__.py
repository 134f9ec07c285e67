"""Registry of hands by name."""

import functools
import os
import pathlib
from collections.abc import Callable

from congrasp.common.errors import CongraspError
from congrasp.common.hands.files import HUMAN, MAX_BYTES, hand_from_text, read_hand, shipped_hand
from congrasp.common.hands.left import LEFT, SIDE, left_hand
from congrasp.common.hands.mano import own_mano_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import user_folder
from congrasp.common.io.inputs import LONGEST_NAME

HANDS: dict[str, Callable[[], Hand]] = {
    "human": lambda: HUMAN,
    "allegro": functools.partial(shipped_hand, "allegro"),
    "sharpa": functools.partial(shipped_hand, "sharpa"),
    "mano": own_mano_hand,
}
"""Makers of the hands; `mano` needs the user's own file."""
SUFFIX = ".json"
VARIABLE = "CONGRASP_HANDS"
"""Environment variable with the folder of the user's custom hands."""


def own_hands() -> dict[str, pathlib.Path]:
    """Returns the files of the user's custom hands by name: those in `hands_folder`."""
    return {path.stem: path for path in sorted(hands_folder().glob(f"*{SUFFIX}"))}


def hands_folder() -> pathlib.Path:
    """Folder of the user's custom hands: `CONGRASP_HANDS`, or congrasp/hands in the user's
    configuration.
    """
    return pathlib.Path(
        os.environ.get(VARIABLE) or user_folder("XDG_CONFIG_HOME", ".config") / "congrasp" / "hands"
    )


def right_name(name: str) -> tuple[str, bool]:
    """Splits a hand's name into the name of the right hand, and True if it names the left one.

    `NAME:left` is the left one of any hand or policy, but `NAME_left` only of a built-in hand:
    other names may end so.
    """
    if name.endswith(SIDE):
        return name.removesuffix(SIDE), True
    right = name.removesuffix(LEFT)
    if right != name and right in HANDS:
        return right, True
    return name, False


def check_reference(reference: object) -> str:
    """Returns a policy's reference to its hand: a name or the hand's full text, but never a path.

    Raises:
      CongraspError: `reference` is neither.
    """
    name = reference if isinstance(reference, str) and len(reference) <= MAX_BYTES else ""
    if (name.isidentifier() and len(name) <= LONGEST_NAME) or name.lstrip().startswith("{"):
        return name
    raise _unknown_hand_error(reference)


def known_hand(reference: object) -> Hand:
    """Returns the hand named by a message or a recording: one of the package, or one whose text is
    included.

    Input from others opens no file of this machine, so that a peer can neither probe for files nor
    make a reader wait.

    Raises:
      CongraspError: it is neither, or the text does not describe a hand.
    """
    name = check_reference(reference)
    if right_name(name)[0] in HANDS:
        return get_hand(name)
    if name.isidentifier():
        raise _unknown_hand_error(reference)
    return hand_from_text(name)


def _unknown_hand_error(reference: object) -> CongraspError:
    """Error for a hand that a message cannot name."""
    return CongraspError(
        f"{ascii(reference)[:60]} is not a built-in hand, and messages may name only those.",
        f"Choose from: {', '.join(sorted(HANDS))}.",
    )


@functools.lru_cache(maxsize=64)
def get_hand(reference: str) -> Hand:
    """Returns the hand of a reference, the same object for the same reference; see `known_hand` for
    untrusted input.

    Args:
      reference: the name of a hand of the package (`human:left` for its mirror image) or of one in
        `hands_folder`, the path of a hand file, or all of its text (`Hand.reference`).

    Raises:
      CongraspError: there is no such hand; the message lists the available ones.
    """
    right, left = right_name(reference)
    if left and right in HANDS:
        return left_hand(get_hand(right))
    if reference in HANDS:
        return HANDS[reference]()
    if reference.lstrip().startswith("{"):
        return hand_from_text(reference)
    user_hands = own_hands()
    if reference in user_hands:
        return read_hand(user_hands[reference])
    if reference.endswith(SUFFIX):
        return read_hand(pathlib.Path(reference))
    if reference.lower().endswith((".urdf", ".xml")):
        what = f"{reference} is a robot description, not a hand file."
        raise CongraspError(what, f"Pass the file that 'congrasp hands import {reference}' writes.")
    raise CongraspError(
        f"There is no hand '{reference}'.",
        f"Choose one of: {', '.join(sorted({*HANDS, *user_hands}))}; or pass a hand file.",
    )
