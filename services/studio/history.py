"""Undo and redo of what a user does to the request."""

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
"""Methods of `Studio` that a page may call, with their arguments by name, and what a person calls each."""
_MOST = 100  # edits that can be undone


class History:
    """Does edits, and takes them back one by one; an edit that fails leaves everything as it was."""

    def __init__(self, studio: Studio):
        """Nothing has been done to the studio's request yet."""
        self._studio = studio
        self._done: list[tuple[str, Edit]] = []
        self._undone: list[tuple[str, Edit]] = []
        self._gesture: Any = None

    def do(self, action: str, *, gesture: Any = None, **values: Any) -> None:
        """Calls one of `ACTIONS`; those of one gesture in a row, such as of a slider that is dragged, are one edit.

        Raises:
          CongraspError: it cannot be done.
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
        """Takes the last edit back, if there is one."""
        self._swap(self._done, self._undone)

    def redo(self) -> None:
        """Does again what was undone last, if nothing was done since."""
        self._swap(self._undone, self._done)

    def view(self) -> dict[str, str]:
        """Labels of the next undo and redo; empty if there is none."""
        found = {"undo": self._done, "redo": self._undone}
        return {name: ACTIONS[edits[-1][0]] if edits else "" for name, edits in found.items()}

    def _swap(self, source: list[tuple[str, Edit]], target: list[tuple[str, Edit]]) -> None:
        """Goes to the last edit of one list, and keeps the present one in the other."""
        self._gesture = None
        if source:
            action, edit = source.pop()
            target.append((action, self._studio.edit))
            self._studio.edit = edit
