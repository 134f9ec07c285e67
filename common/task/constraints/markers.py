"""Markers of constraints in pictures, recordings and the studio; all are in the object frame."""

from typing import NamedTuple

import numpy as np


class Arrow(NamedTuple):
    """A direction that ends at a point."""

    tip: np.ndarray
    """(3,) m."""
    direction: np.ndarray
    """(3,) unit vector."""


class Polyline(NamedTuple):
    """A sequence of connected points."""

    points: np.ndarray
    """(n, 3) m."""


class Ghost(NamedTuple):
    """A translucent hand."""

    position: np.ndarray
    """(3,) position of the wrist, m."""
    quaternion: np.ndarray
    """(4,) orientation of the wrist."""
    q: np.ndarray | None
    """(F,) finger angles, rad; None draws only the wrist's axes."""


class Paint(NamedTuple):
    """The avoid region, painted on the object."""


Marker = Arrow | Polyline | Ghost | Paint
