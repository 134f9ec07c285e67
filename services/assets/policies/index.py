"""The index of a release's policies: their addresses, sizes and hashes.

An index is a JSON file, here with one policy::

    {"policies": {"human-2300": {
      "address": "human-2300.safetensors",
      "sha256": "9f86d081…",
      "bytes": 2246256,
      "description": "Human hand, trained with heavy objects"
    }}}

An address is of http or https, or relative to the index.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.services.assets.policies.transfer import read_bytes, resolve

VARIABLE = "CONGRASP_POLICIES_INDEX"
"""Environment variable with the index of commands without --index."""
_PACKAGED = pathlib.Path(__file__).with_name("policies.json")
"""Index of the release."""
_MAX_BYTES = 1_000_000
_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclasses.dataclass(frozen=True)
class Entry:
    """A policy in an index."""

    name: str
    """Name of the policy, with which commands find its file."""
    address: str
    """Path, or http or https address, of the file."""
    sha256: str
    """SHA-256 of the file, in hexadecimal digits."""
    bytes: int
    """Size of the file."""
    description: str = ""
    """Hand, training and use of the policy."""


def index_source(option: str = "") -> str:
    """Returns the path or address of the index: of the option, the environment or the release."""
    return option or os.environ.get(VARIABLE) or str(_PACKAGED)


def read_index(source: str, deadline: float) -> dict[str, Entry]:
    """Returns the policies of an index by name.

    Args:
      source: path, or http or https address, of the index.
      deadline: longest time for an address, s.

    Raises:
      CongraspError: the index cannot be read, or is not one.
      TransportError: the address cannot be reached in time.
    """
    content = read_bytes(source, _MAX_BYTES, deadline)
    try:
        described = json.loads(content)["policies"].items()
        return {name: _entry(name, fields, source) for name, fields in described}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise CongraspError(
            f"{source} is not an index of policies.",
            "An index is JSON with name, address, sha256 and bytes of each policy.",
        ) from None


def _entry(name: str, fields: Mapping[str, Any], source: str) -> Entry:
    """Returns an entry of an index.

    Raises:
      ValueError, KeyError, TypeError: a field is absent or invalid.
      CongraspError: its address is not allowed in this index.
    """
    sha256 = fields["sha256"].lower()
    size = fields["bytes"]
    if not _NAME.fullmatch(name) or not _SHA256.fullmatch(sha256):
        raise ValueError(name)
    if not isinstance(size, int) or size < 1:
        raise ValueError(name)
    address = resolve(source, fields["address"])
    return Entry(name, address, sha256, size, str(fields.get("description", "")))


def has_content(path: pathlib.Path, sha256: str) -> bool:
    """Returns True if there is a file with this SHA-256."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() == sha256
    except OSError:
        return False


def fetch(entry: Entry, target: pathlib.Path, max_bytes: int, deadline: float) -> None:
    """Writes a policy to a file, atomically, if its content has the hash of the index.

    Args:
      entry: of the index.
      target: file to write; earlier content is intact after an error.
      max_bytes: largest size.
      deadline: longest time, s.

    Raises:
      CongraspError: the content has another hash or is too large, or the file cannot be written.
      TransportError: the address cannot be reached in time.
    """
    if entry.bytes > max_bytes:
        raise CongraspError(
            f"'{entry.name}' is larger than {max_bytes / 1e6:g} MB: {entry.bytes / 1e6:g} MB.",
            "Raise --limit.",
        )
    content = read_bytes(entry.address, entry.bytes, deadline)
    sha256 = hashlib.sha256(content).hexdigest()
    if sha256 != entry.sha256:
        raise CongraspError(
            f"{entry.address} has the SHA-256 {sha256}, but the index has {entry.sha256}: it was "
            f"not stored.",
            "Try again, and report it if the hashes still differ.",
        )
    write_atomically(target, content)


def index_of(files: Sequence[pathlib.Path], base: str = "") -> str:
    """Returns the index of policy files.

    Args:
      files: policies, named after their files.
      base: address of their folder; empty if the index is to be in it.
    """
    policies = {}
    for file in sorted(files):
        content = file.read_bytes()
        policies[file.stem] = {
            "address": f"{base}{file.name}",
            "sha256": hashlib.sha256(content).hexdigest(),
            "bytes": len(content),
            "description": "",
        }
    return json.dumps({"policies": policies}, indent=2) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the index of the files on the command line."""
    parser = argparse.ArgumentParser(description="Prints the index of policy files.")
    parser.add_argument("files", type=pathlib.Path, nargs="+", help="policy files")
    parser.add_argument("--base", default="", help="address of their folder, with a final slash")
    options = parser.parse_args(arguments)
    print(index_of(options.files, options.base), end="")


if __name__ == "__main__":
    main()
