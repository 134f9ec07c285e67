"""Counts of an exam's lost episodes: those that noise or a search holds, and those that nothing
does.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, NamedTuple

from congrasp.services.evaluate.text_table import Table

Reached = Literal["noise", "search", ""]
"""Stage that held a condition; empty if none did."""


@dataclasses.dataclass
class Lost:
    """A condition of the exam in which the policy does not hold the object."""

    row: str
    """Constraints of the row."""
    object: str
    """Name of the object."""
    episode: int
    """Index of the episode in its row."""
    success: bool
    """True if the object fell only after the paper's 25 control steps without the table."""
    repeat_held: bool = False
    """True if the policy holds the object when the episode is repeated unchanged in another
    environment: the condition is marginal, and its loss is not a property of it alone."""
    noise_attempts: int = 0
    noise_held: int = 0
    """Attempts with exploration noise, and those that held the object for two seconds."""
    search_attempts: int = 0
    search_held: int = 0
    """Candidates of the search, and those that held the object for two seconds."""

    @property
    def reached(self) -> Reached:
        """First stage that held the object."""
        if self.noise_held:
            return "noise"
        if self.search_held:
            return "search"
        return ""


class Counts(NamedTuple):
    """Episodes of an object, or of several."""

    name: str
    episodes: int
    lost: int
    noise: int
    """Lost episodes that an attempt with noise holds."""
    search: int
    """Lost episodes that only the search holds."""

    @property
    def unreached(self) -> int:
        """Lost episodes that no stage has held."""
        return self.lost - self.noise - self.search

    @property
    def held(self) -> float:
        """Share of the episodes that the policy holds."""
        return (self.episodes - self.lost) / self.episodes

    @property
    def ceiling(self) -> float:
        """Share of the episodes that the policy or a stage holds."""
        return (self.episodes - self.unreached) / self.episodes

    def to_json(self) -> dict[str, Any]:
        """Returns the counts and rates for a file."""
        rates = {"held": self.held, "ceiling": self.ceiling}
        return {**self._asdict(), "unreached": self.unreached, **rates}


def counts_of(name: str, episodes: int, lost: Iterable[Lost]) -> Counts:
    """Counts the conditions of `episodes` episodes."""
    stages = [condition.reached for condition in lost]
    return Counts(name, episodes, len(stages), stages.count("noise"), stages.count("search"))


def by_object(episodes: Sequence[tuple[str, str]], lost: Sequence[Lost]) -> list[Counts]:
    """Counts of each object, most unreached first.

    Args:
      episodes: row and object of every episode of the exam.
      lost: the lost ones.
    """
    counts = _grouped([name for _, name in episodes], lost, lambda condition: condition.object)
    return sorted(counts, key=lambda one: (-one.unreached, -one.lost, one.name))


def by_row(episodes: Sequence[tuple[str, str]], lost: Sequence[Lost]) -> list[Counts]:
    """Counts of each row, in the order of the exam; see `by_object`."""
    return _grouped([row for row, _ in episodes], lost, lambda condition: condition.row)


def _grouped(
    groups: Sequence[str], lost: Sequence[Lost], group_of: Callable[[Lost], str]
) -> list[Counts]:
    """Counts of each group of episodes."""
    counts = []
    for group in dict.fromkeys(groups):
        members = [condition for condition in lost if group_of(condition) == group]
        counts.append(counts_of(group, groups.count(group), members))
    return counts


def table(title: str, counts: Sequence[Counts]) -> Table:
    """Returns the table of these counts."""
    columns: list[tuple[str, Callable[[Counts], str]]] = [
        ("", lambda one: one.name),
        ("episodes", lambda one: str(one.episodes)),
        ("lost", lambda one: str(one.lost)),
        ("reached by noise", lambda one: str(one.noise)),
        ("reached by search", lambda one: str(one.search)),
        ("unreached", lambda one: str(one.unreached)),
        ("held", lambda one: f"{100 * one.held:.1f} %"),
        ("ceiling", lambda one: f"{100 * one.ceiling:.1f} %"),
    ]
    return Table.of(title, counts, columns)
