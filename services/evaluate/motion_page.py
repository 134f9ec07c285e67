"""A page with one motion in three dimensions, for a browser or a notebook."""

import pathlib

from congrasp.common.episode.episode import Episode
from congrasp.services.evaluate.pages import template
from congrasp.services.evaluate.pictures import turntable

_TEMPLATE = pathlib.Path(__file__).with_suffix(".html")


def motion_page(episode: Episode) -> str:
    """Returns a self-contained HTML page that plays the motion; the mouse turns the view.

    Args:
      episode: the motion of `congrasp.grasp`, or an episode of a recording.

    Raises:
      CongraspError: jinja2 is not installed, or the episode is from a motion file, which has no
        hand.
    """
    page = template(_TEMPLATE).render(title=episode.object, motion=turntable(episode))
    return str(page)
