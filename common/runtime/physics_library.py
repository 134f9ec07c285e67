"""MuJoCo, imported without its log file. The other modules take `mujoco` from here.

MuJoCo appends its warnings, such as that of an unstable simulation, to MUJOCO_LOG.TXT in the
working directory, which is the user's. It has no setting for this, only a handler of warnings for
the whole process. Divergence is detected by `Physics.diverged`, and errors are exceptions.
"""

import mujoco

__all__ = ["mujoco"]


def _ignore(text: str) -> None:
    """Discards a warning."""


# A handler of the program that imports this package stays.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(_ignore)
