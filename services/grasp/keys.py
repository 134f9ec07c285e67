"""Identity of a grasp: a key that changes with any input, so that finished grasps are skipped."""

import dataclasses
import hashlib
import json
import pathlib
from collections.abc import Mapping
from typing import Any

from congrasp.services.assets.objects.options import ImportOptions

_FORMAT = 4
"""Version of result.json: results of another version are repeated."""


def key_of(*parts: Any) -> str:
    """Sixteen hex digits that change with any input of a grasp."""
    content = json.dumps((_FORMAT, *parts), default=str)
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def identity_of_options(options: ImportOptions) -> dict[str, Any]:
    """Import options without the location of the cache."""
    return dataclasses.asdict(dataclasses.replace(options, cache_dir=""))


def identity_of_constraints(constraints: Mapping[str, Any]) -> dict[str, list[str]]:
    """Identities of the constraints in use, by option.

    Args:
      constraints: texts, flags or sequences of texts (see `services.grasp.parse.read_request`).

    Returns:
      A list of identities for each option that is set.
    """
    identities: dict[str, list[str]] = {}
    for name, value in constraints.items():
        if not value:
            continue
        texts = [str(value)] if isinstance(value, str | bool) else value
        identities[name] = [identity_of_text(text) for text in texts]
    return identities


def identity_of_text(text: str) -> str:
    """Identity of a constraint's text; for the name of a file, the file's content.

    FILE:PART, with a number or the name of a joint, is a file with a part.
    """
    file, _, part = text.rpartition(":")
    for name, suffix in ((text, "0"), (file, part)):
        if name and pathlib.Path(name).is_file():
            content = pathlib.Path(name).read_bytes()
            return f"{hashlib.sha256(content).hexdigest()}:{suffix}"
    return text
