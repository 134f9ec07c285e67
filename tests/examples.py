"""The programs of `examples/`, as modules."""

import importlib
import sys
from typing import Any
from unittest import mock

from tests.conftest import ROOT

EXAMPLES = ROOT / "examples"


def example(name: str) -> Any:
    """Imports a program, which finds those next to it."""
    with mock.patch.object(sys, "path", [str(EXAMPLES), *sys.path]):
        return importlib.import_module(name)
