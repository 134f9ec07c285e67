"""What a constraint looks like in pictures, recordings and the studio; all in the object frame."""

from typing import NamedTuple

import numpy as np


class Arrow(NamedTuple):
    """A direction that ends at a point."""

    tip: np.ndarray
    """(3,) m."""
    direction: np.ndarray
    """(3,) unit vector."""


class Polyline(NamedTuple):
    """Points on a string."""

    points: np.ndarray
    """(n, 3) m."""


class Ghost(NamedTuple):
    """A translucent hand."""

    position: np.ndarray
    """(3,) m, of the wrist."""
    quaternion: np.ndarray
    """(4,), of the wrist."""
    q: np.ndarray | None
    """(F,) rad, finger angles; None draws the wrist's axes alone."""


class Paint(NamedTuple):
    """The avoid region, painted on the object."""


Marker = Arrow | Polyline | Ghost | Paint
