"""MuJoCo, imported without its log file and despite a `MUJOCO_GL` that does not work on this
machine. The other modules take `mujoco` from here.

MuJoCo appends its warnings, such as that of an unstable simulation, to MUJOCO_LOG.TXT in the
working directory, which is the user's. It has no setting for this, only a handler of warnings for
the whole process. Divergence is detected by `Physics.diverged`, and errors are exceptions.

`MUJOCO_GL` selects a renderer, which nothing here uses; a value left over from another project ends
the import of MuJoCo with one of many errors.
"""

import os

_RENDERER = "MUJOCO_GL"

try:
    import mujoco
except ModuleNotFoundError:
    raise
except Exception:
    renderer = os.environ.get(_RENDERER)
    if renderer is None:
        raise
    os.environ[_RENDERER] = "disable"
    try:
        import mujoco
    finally:
        os.environ[_RENDERER] = renderer

__all__ = ["mujoco"]


def _ignore(text: str) -> None:
    """Discards a warning."""


# A handler of the program that imports this package stays.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(_ignore)
