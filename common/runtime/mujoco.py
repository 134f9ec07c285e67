"""MuJoCo, imported despite a `MUJOCO_GL` that does not work on this machine.

`MUJOCO_GL` selects a renderer, which nothing here uses; a value left over from another project ends
the import of MuJoCo with one of many errors.
"""

import os

_VARIABLE = "MUJOCO_GL"

try:
    import mujoco
except ModuleNotFoundError:
    raise
except Exception:
    renderer = os.environ.get(_VARIABLE)
    if renderer is None:
        raise
    os.environ[_VARIABLE] = "disable"
    try:
        import mujoco
    finally:
        os.environ[_VARIABLE] = renderer

__all__ = ["mujoco"]
