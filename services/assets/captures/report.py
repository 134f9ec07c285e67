"""Report of an import of captures: kept and dropped sequences."""

import collections
import dataclasses
from typing import Any

from congrasp.services.assets.captures.sequence import Dropped


@dataclasses.dataclass
class Report:
    """Outcome of each sequence."""

    kept: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    dropped: list[dict[str, str]] = dataclasses.field(default_factory=list)

    def drop(self, dropped: Dropped) -> None:
        """Records a dropped sequence."""
        self.dropped.append(
            {"sequence": dropped.name, "rule": dropped.rule, "reason": dropped.reason}
        )

    def rules(self) -> list[tuple[str, int, str]]:
        """Returns the name of each rule, the sequences that it dropped, and the first reason."""
        counts = collections.Counter(row["rule"] for row in self.dropped)
        first: dict[str, str] = {}
        for row in self.dropped:
            first.setdefault(row["rule"], f"{row['sequence']}: {row['reason']}")
        return [(rule, count, first[rule]) for rule, count in counts.most_common()]
