"""trimesh, imported at the first use of one of its names.

The import takes most of a second. Processes of a run import modules that use it for some objects
alone.
"""

from typing import TYPE_CHECKING

from congrasp.common.runtime.lazy_module import LazyModule

if TYPE_CHECKING:
    import trimesh
else:
    trimesh = LazyModule("trimesh")

__all__ = ["trimesh"]
