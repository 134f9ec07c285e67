"""Figures of record: what `congrasp evaluate --json` wrote into `docs/results`, and the tables that pages show of it."""

import importlib.metadata
import platform
import shlex
import sys
from typing import Any

import jax

from common.parallel import cores


def provenance() -> dict[str, Any]:
    """Version of the package, the command line and the machine of an evaluation that runs now."""
    device = jax.local_devices()[0]
    return {
        "version": importlib.metadata.version("congrasp"),
        "command": shlex.join(["congrasp", *sys.argv[1:]]),
        "machine": f"{cores()} {platform.machine()} cores"
        + ("" if device.platform == "cpu" else f", {device.device_kind}"),
    }
