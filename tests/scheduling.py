"""Order in which the workers of pytest-xdist get the modules of the tests."""

import collections
import pathlib
from typing import Any

from xdist.scheduler import LoadFileScheduling


class LoadFolderScheduling(LoadFileScheduling):
    """Hands a worker the modules of one folder after the other, one at a time.

    Modules of a folder share traced programs and session fixtures, which each worker makes for
    itself. A worker therefore continues with its last folder, then with a folder that no worker has
    begun, and then helps with the folder of which most modules are left.
    """

    def __init__(self, config: Any, log: Any = None):
        super().__init__(config, log)
        self._folders: dict[Any, str] = {}
        """The folder of each worker's last module."""
        self._begun: set[str] = set()

    def _assign_work_unit(self, node: Any) -> None:
        module = self._next_module(node)
        folder = folder_of(module)
        self._folders[node] = folder
        self._begun.add(folder)
        self.workqueue.move_to_end(module, last=False)
        super()._assign_work_unit(node)

    def _next_module(self, node: Any) -> str:
        """The module that a worker gets next."""
        modules = list(self.workqueue)
        for module in modules:
            if folder_of(module) == self._folders.get(node):
                return module
        for module in modules:
            if folder_of(module) not in self._begun:
                return module
        counts = collections.Counter(map(folder_of, modules))
        ((largest, _),) = counts.most_common(1)
        return next(module for module in modules if folder_of(module) == largest)


def folder_of(module: str) -> str:
    """The folder of a module's path."""
    return str(pathlib.PurePosixPath(module).parent)
