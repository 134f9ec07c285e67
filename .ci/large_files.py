#!/usr/bin/env python3
"""Reports files of the repository above 1 MB: every version of one stays in each full clone.

Exceptions are listed in `.ci/large_files.txt`, one path a line. A listed file that is no longer
tracked, or no longer large, is an error, too.

    python3 .ci/large_files.py
"""

import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).parent.parent
LIMIT = 1_000_000
"""Bytes."""
EXCEPTIONS = pathlib.Path(__file__).with_name("large_files.txt")


def tracked_files() -> list[str]:
    """Paths of the files that git tracks or is about to commit."""
    command = ["git", "-C", str(ROOT), "ls-files", "-z"]
    listing = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return [name for name in listing.split("\0") if name]


def is_large(name: str) -> bool:
    """True for a file above the limit; a deleted one is small."""
    path = ROOT / name
    return path.is_file() and path.stat().st_size > LIMIT


def main() -> int:
    """Prints the files that break the rule; returns 1 if there are any."""
    exceptions = set(EXCEPTIONS.read_text().split())
    large = {name for name in tracked_files() if is_large(name)}
    for name in sorted(large - exceptions):
        print(
            f"{name} is above {LIMIT / 1e6:g} MB: make it smaller, publish it with a release, or "
            f"list it in {EXCEPTIONS.name}"
        )
    for name in sorted(exceptions - large):
        print(f"{name} is not a large file: remove it from {EXCEPTIONS.name}")
    return int(large != exceptions)


if __name__ == "__main__":
    sys.exit(main())
