"""Hands by name: the one place that knows them all."""

import functools
from collections.abc import Callable

from common.errors import CongraspError
from common.hands.allegro import ALLEGRO
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


@functools.cache
def get_hand(name: str) -> Hand:
    """The hand of this name, the same object every time; a CongraspError lists those that exist."""
    if name not in HANDS:
        raise CongraspError(f"There is no hand '{name}'.", f"Choose one of: {', '.join(sorted(HANDS))}.")
    return HANDS[name]()
