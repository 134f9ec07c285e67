"""Hands by name."""

from common.errors import CongraspError
from common.hands.human import HUMAN
from common.hands.spec import Hand

HANDS: dict[str, Hand] = {hand.name: hand for hand in (HUMAN,)}


def get_hand(name: str) -> Hand:
    """The hand of this name; a CongraspError lists those that exist."""
    if name not in HANDS:
        raise CongraspError(f"There is no hand '{name}'.", f"Choose one of: {', '.join(sorted(HANDS))}.")
    return HANDS[name]
