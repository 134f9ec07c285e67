"""Undo and redo of changes to the request."""

from typing import Any

from congrasp.services.studio.state import Edit, Studio

ACTIONS = {
    "set_rest_pose": "resting pose",
    "ask": "constraint on or off",
    "choose": "choice of flags",
    "set_heading": "heading",
    "snap_heading": "heading",
    "set_roll": "roll",
    "paint": "brush stroke",
    "fill": "painting of everything",
    "close_hand": "reference pose",
    "draw": "wrist path",
    "suggest": "suggestion",
}
"""Methods of `Studio` that a page may call, with their arguments by name, and their labels on the page."""
_MOST = 100  # edits that can be undone


class History:
    """Makes edits and undoes them one by one; an edit that fails changes nothing."""

    def __init__(self, studio: Studio):
        """Begins without edits."""
        self._studio = studio
        self._done: list[tuple[str, Edit]] = []
        self._undone: list[tuple[str, Edit]] = []
        self._gesture: Any = None

    def do(self, action: str, *, gesture: Any = None, **values: Any) -> None:
        """Calls one of `ACTIONS`. Successive calls of one gesture, such as dragging a slider, are one edit.

        Raises:
          CongraspError: the action fails.
        """
        before = self._studio.edit
        try:
            getattr(self._studio, action)(**values)
        except BaseException:
            self._studio.edit = before
            raise
        if gesture is None or gesture != self._gesture:
            self._done = [*self._done, (action, before)][-_MOST:]
        self._gesture = gesture
        self._undone.clear()

    def undo(self) -> None:
        """Undoes the last edit, if there is one."""
        self._swap(self._done, self._undone)

    def redo(self) -> None:
        """Repeats the edit that was undone last, if no other followed."""
        self._swap(self._undone, self._done)

    def view(self) -> dict[str, str]:
        """Labels of the next undo and redo; empty if there is none."""
        found = {"undo": self._done, "redo": self._undone}
        return {name: ACTIONS[edits[-1][0]] if edits else "" for name, edits in found.items()}

    def _swap(self, source: list[tuple[str, Edit]], target: list[tuple[str, Edit]]) -> None:
        """Restores the last edit of `source`, and keeps the current one in `target`."""
        self._gesture = None
        if source:
            action, edit = source.pop()
            target.append((action, self._studio.edit))
            self._studio.edit = edit
