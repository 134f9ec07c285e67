"""Policies of the package and of releases: list them, download more, and average some."""

import dataclasses
import pathlib
from typing import Annotated

import tyro

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import check_output
from congrasp.common.shell import shell_command
from congrasp.services.assets.policies.index import (
    VARIABLE,
    Entry,
    fetch,
    has_content,
    index_source,
    read_index,
)
from congrasp.services.cli.console import in_range, say, show_table
from congrasp.services.cli.suggestions import nearest
from congrasp.services.ops.logs import announce_progress

_MB = 1_000_000
_LARGEST_MB = 10_000


@dataclasses.dataclass(frozen=True)
class List:
    """List the policies of the package, those that you have downloaded, and those of an index.

    Policies of the package and downloaded ones are listed without a connection, too.

    Examples:
      congrasp policies list
      congrasp policies list --index policies.json
    """

    index: str = ""
    """Path, or http or https address, of the index; by default that of CONGRASP_POLICIES_INDEX, or
    of the release."""
    timeout: float = 30.0
    """Seconds for an index from the web."""

    def __call__(self) -> int:
        """Prints a table."""
        from congrasp.common.policy.pretrained import (
            packaged_policies,
            policies_folder,
            stored_policies,
        )

        in_range(0.1, timeout=self.timeout)
        packaged = packaged_policies()
        stored = stored_policies()
        rows = [(name, "package", _size(path), "") for name, path in packaged.items()]
        rows += [(name, "downloaded", _size(path), "") for name, path in stored.items()]
        source = index_source(self.index)
        error = None
        try:
            entries = read_index(source, self.timeout)
        except CongraspError as failure:
            entries = {}
            error = failure
        local = {**packaged, **stored}
        for entry in entries.values():
            path = local.get(entry.name)
            if path is None or not has_content(path, entry.sha256):
                rows.append((entry.name, "index", f"{entry.bytes / _MB:.1f} MB", entry.description))
        show_table(("policy", "place", "size", "description"), rows)
        say(f"Downloaded policies are the files in {policies_folder()}.")
        if error is not None:
            raise error
        return 0


@dataclasses.dataclass(frozen=True)
class Get:
    """Download a policy of an index into your folder of policies.

    The file is stored only if its SHA-256 is that of the index. Afterwards all commands take the
    name of the policy as --policy.

    Examples:
      congrasp policies get human-2300
      congrasp policies get human-2300 --index policies.json --out human.safetensors
    """

    name: Annotated[str, tyro.conf.Positional]
    """Name of the policy ('congrasp policies list' prints the names)."""
    index: str = ""
    """Path, or http or https address, of the index; by default that of CONGRASP_POLICIES_INDEX, or
    of the release."""
    out: pathlib.Path | None = None
    """File to write; by default NAME.safetensors in your folder of policies ('congrasp policies
    list' prints this folder)."""
    timeout: float = 300.0
    """Seconds for the index, and again for the policy."""
    limit: float = 100.0
    """Largest size of a policy, MB."""

    def __call__(self) -> int:
        """Downloads the policy, and prints its file."""
        from congrasp.common.policy.pretrained import packaged_policies, stored_file

        in_range(0.1, timeout=self.timeout)
        in_range(0.001, _LARGEST_MB, limit=self.limit)
        source = index_source(self.index)
        entry = _find(self.name, read_index(source, self.timeout), source)
        packaged = packaged_policies().get(entry.name)
        target = self.out or stored_file(entry.name)
        option = "--out" if self.out else "The default of --out"
        check_output(option, target, is_folder=False)
        if packaged is not None and self.out is None:
            if has_content(packaged, entry.sha256):
                say(f"'{entry.name}' is part of the package: {packaged}")
                return 0
            raise CongraspError(
                f"The package has another policy with the name '{entry.name}'.",
                "Pass --out FILE, and this file as --policy.",
            )
        if has_content(target, entry.sha256):
            say(f"{target} is up to date.")
            return 0
        with announce_progress(f"Downloading {entry.address}"):
            fetch(entry, target, round(self.limit * _MB), self.timeout)
        reference = entry.name if self.out is None else self.out
        say(target, f"Try: {shell_command('congrasp', 'grasp', 'mug:7', '--policy', reference)}")
        return 0


@dataclasses.dataclass(frozen=True)
class Average:
    """Average the weights of a policy that was trained further and of the policies before it.

    The mean often keeps what both can do. It needs a training that began with the other policy
    (--initial): policies of separate trainings have no useful mean. Compare it with both by
    'congrasp evaluate'.

    Examples:
      congrasp policies average runs/mine/policy.safetensors human --weights 0.5 0.5
      congrasp policies average new.safetensors old.safetensors --weights 0.7 0.3
    """

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Policy files, or names of policies ('congrasp policies list'). Task, version and number of
    steps of the result are those of the first."""
    weights: tuple[float, ...]
    """Weight of each policy; their sum is 1."""
    out: pathlib.Path = pathlib.Path("mean.safetensors")
    """File to write."""

    def __call__(self) -> int:
        """Writes the mean."""
        from congrasp.common.policy.average import average
        from congrasp.common.policy.bundle import load, save
        from congrasp.common.policy.pretrained import named_policy

        save(average([load(named_policy(name)) for name in self.policies], self.weights), self.out)
        say(self.out, f"Try: {shell_command('congrasp', 'evaluate', '--policy', self.out)}")
        return 0


def _size(path: pathlib.Path) -> str:
    """Size of a file."""
    return f"{path.stat().st_size / _MB:.1f} MB"


def _find(name: str, entries: dict[str, Entry], source: str) -> Entry:
    """Returns the policy of this name in an index.

    Raises:
      CongraspError: the index has none.
    """
    from congrasp.common.policy.pretrained import packaged_policies

    if name in entries:
        return entries[name]
    remedy = f"Choose from: {', '.join(entries)}."
    similar = nearest(name, entries)
    if similar:
        remedy = f"Did you mean '{similar}'?"
    if not entries:
        remedy = (
            f"It has none: pass --index with the path or address of another one, or set {VARIABLE}."
        )
    if name in packaged_policies():
        remedy = "It is part of the package and needs no download."
    raise CongraspError(f"The index {source} has no policy '{name}'.", remedy)


COMMANDS = {"list": List, "get": Get, "average": Average}
