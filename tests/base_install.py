"""Python with numpy and zenoh alone, as a control loop has it, and a policy server for it that
costs nothing.
"""

import contextlib
import subprocess
from collections.abc import Iterator

import numpy as np

from congrasp.common.hands import get_hand
from congrasp.common.task.config import TaskConfig
from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys, below
from congrasp.common.transport.ports import free_port
from congrasp.common.wire.codec import Message
from congrasp.services.serve.inference import Inference, PolicyFunction
from tests.children import python

BASE_INSTALL = """
import sys


class BaseInstall:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in sys.stdlib_module_names | {"numpy", "zenoh", "congrasp"}:
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)


sys.meta_path.insert(0, BaseInstall())
"""


def run_in_base_install(code: str) -> subprocess.CompletedProcess[str]:
    """Runs a program that finds the standard library, numpy, zenoh and congrasp alone."""
    return python("-c", BASE_INSTALL + code, timeout=60)


@contextlib.contextmanager
def steady_server(hand: str = "allegro") -> Iterator[int]:
    """Port of a server whose policy wants every joint at zero."""
    port = free_port()
    keys = Keys("policy")
    function = PolicyFunction(get_hand(hand), TaskConfig(hand=hand))

    def act(key: str, query: Message) -> Message:
        targets = np.zeros((1, 2 * (len(get_hand(hand).joints) + 6)), np.float32)  # and the action
        return Inference(targets, [[]]).reply({"version": 1, "total_ms": 0.0})

    with urls.listen(f"tcp/127.0.0.1:{port}", "server") as server:
        server.serve(keys.health, lambda key, query: Message({}, function.metadata()))
        server.serve(below(keys.act), act)
        yield port
