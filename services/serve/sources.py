"""Sources of the policy that a server serves: a file, or a learner's run."""

import pathlib
from collections.abc import Callable

from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message

Source = Callable[[int], PolicyBundle | None]
"""(current version, -1 for none) -> a newer bundle; None if there is none."""

_PULL_TIMEOUT_S = 5.0


def follow_file(path: pathlib.Path) -> Source:
    """Returns a source that rereads a policy file whenever it changes, and until it can be read."""
    loaded_mtime: float | None = None
    """Time of the file's last change when it was loaded."""

    def read(version: int) -> PolicyBundle | None:
        nonlocal loaded_mtime
        try:
            mtime = path.stat().st_mtime
        except OSError:
            raise CongraspError(
                f"The policy {path} cannot be read.", "Pass a file created by 'congrasp train'."
            ) from None
        if version >= 0 and loaded_mtime == mtime:
            return None
        bundle = bundles.load(path)
        loaded_mtime = mtime
        return bundle

    return read


def follow_run(transport: Transport, run: str, name: str) -> Source:
    """Returns a source that pulls the newest policy from a learner, under the server's name on the
    wire.
    """
    key = Keys(run).weights_for("server", name)

    def pull(version: int) -> PolicyBundle | None:
        request = Message({}, {"newer_than": version})
        reply = transport.query(key, request, timeout=_PULL_TIMEOUT_S)
        return PolicyBundle.from_message(reply, "of the learner") if reply.arrays else None

    return pull
