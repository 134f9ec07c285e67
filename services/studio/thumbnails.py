"""Pictures of an object's resting poses, rendered on demand."""

import threading

from congrasp.common.errors import CongraspError
from congrasp.common.objects.spec import GraspObject
from congrasp.services.studio.server import Picture
from congrasp.services.viz.object_sheet import rest_picture
from congrasp.services.viz.sheets import png_of

_SIZE = (150, 112)  # pixels


class Thumbnails:
    """Pictures of the resting poses of one object at a time."""

    def __init__(self) -> None:
        """Renders nothing yet."""
        self._lock = threading.Lock()
        self._object: GraspObject | None = None
        self._drawn: dict[int, Picture] = {}

    def picture(self, obj: GraspObject, rest: int) -> Picture:
        """An object in one of its resting poses, from 0; raises a CongraspError if there is none of this number."""
        if not 0 <= rest < len(obj.rest_poses):
            raise CongraspError(f"The object '{obj.name}' has no resting pose {rest + 1}.")
        with self._lock:
            if self._object is not obj:
                self._object, self._drawn = obj, {}
            if rest not in self._drawn:
                self._drawn[rest] = Picture(png_of(rest_picture(obj, rest, _SIZE)))
            return self._drawn[rest]
