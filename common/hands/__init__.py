"""Hands by name: the one place that knows them all."""

import functools
import os
import pathlib
from collections.abc import Callable

from common.errors import CongraspError
from common.hands.allegro import ALLEGRO
from common.hands.files import hand_from_text, read_hand
from common.hands.human import HUMAN
from common.hands.mano import own_mano_hand
from common.hands.sharpa import SHARPA
from common.hands.spec import Hand

HANDS: dict[str, Callable[[], Hand]] = {
    "human": lambda: HUMAN,
    "allegro": lambda: ALLEGRO,
    "sharpa": lambda: SHARPA,
    "mano": own_mano_hand,
}
"""Makers of the hands; `mano` needs the user's own file."""
SUFFIX = ".json"
VARIABLE = "CONGRASP_HANDS"
"""Environment variable with the folder of the user's own hands."""


def own_hands() -> dict[str, pathlib.Path]:
    """Files of the user's own hands by name: those in `hands_folder`."""
    return {path.stem: path for path in sorted(hands_folder().glob(f"*{SUFFIX}"))}


def hands_folder() -> pathlib.Path:
    """Where the user's own hands are: `CONGRASP_HANDS`, or congrasp/hands in the user's configuration."""
    config = os.environ.get("XDG_CONFIG_HOME") or pathlib.Path.home() / ".config"
    return pathlib.Path(os.environ.get(VARIABLE) or pathlib.Path(config, "congrasp", "hands"))


@functools.cache
def get_hand(reference: str) -> Hand:
    """A hand, the same object every time for the same words.

    Args:
      reference: the name of a hand of the package or of one in `hands_folder`, the path of a hand file, or all of its
        text (`Hand.reference`).

    Raises:
      CongraspError: there is no such hand; those that exist are listed.
    """
    if reference in HANDS:
        return HANDS[reference]()
    if reference.lstrip().startswith("{"):
        return hand_from_text(reference)
    own = own_hands()
    if reference in own:
        return read_hand(own[reference])
    if reference.endswith(SUFFIX):
        return read_hand(pathlib.Path(reference))
    raise CongraspError(
        f"There is no hand '{reference}'.", f"Choose one of: {', '.join(sorted({*HANDS, *own}))}; or name a hand file."
    )
