"""Fixtures that several test folders share."""

import os
import sys
import tempfile

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Nobody's own hands and policies.
os.environ["XDG_CONFIG_HOME"] = os.path.join(
    tempfile.gettempdir(), "congrasp-tests-without-configuration"
)
os.environ["XDG_STATE_HOME"] = os.path.join(tempfile.gettempdir(), "congrasp-tests-state")
# Every compiled program is kept, so that neither the other modules nor the processes that tests
# start compile it again.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Most of the time goes into compiling programs that run for a moment.
if os.environ["JAX_PLATFORMS"] == "cpu":
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "true")
    # The older emitters of fused loops compile in half the time; one thread without LLVM's
    # optimiser saves a fifth.
    flags = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 "
    flags += "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    os.environ.setdefault("XLA_FLAGS", flags)
    os.environ["CONGRASP_CHECKED_XLA_FLAGS"] = os.environ["XLA_FLAGS"]  # by every command, else

import ctypes
import gc
import pathlib
from typing import Any

import psutil
import pytest
from hypothesis import settings

# The same examples every time, so that a red run tells of a change; HYPOTHESIS_PROFILE=search looks
# for new ones.
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("search", derandomize=False, deadline=None)
# Tracing makes millions of objects that live on: looking through them often takes a twentieth of
# the time.
gc.set_threshold(200_000, 20, 100)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))

ROOT = pathlib.Path(__file__).resolve().parent.parent
_MOST_MEMORY = 4 << 30  # bytes of a worker
_SLOW_LIMIT_S = 3600

_LONGEST = (
    "actors/test_physics_warp",
    "services/evaluate/test_evaluate",
    "services/grasp/test_grasp",
    "e2e/test_faults",
    "e2e/test_train",
    "e2e/test_security",
    "services/assets/test_cases",
    "services/serve/test_robot_loop",
    "services/assets/objects/test_import",
    "services/test_cli",
    "actors/test_rollout",
    "services/dataset/test_dataset",
    "test_congrasp",
)
"""Modules of over half a minute."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest modules come first, so that at the end no worker runs one while the others
    wait. A slow test has an hour on any machine, since its limit only ends a test that hangs.
    """
    for item in items:
        limit = item.get_closest_marker("timeout")
        if item.get_closest_marker("slow") and (limit is None or limit.args[0] < _SLOW_LIMIT_S):
            item.add_marker(pytest.mark.timeout(_SLOW_LIMIT_S), append=False)
    place = {str(ROOT / "tests" / f"{name}.py"): i for i, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: place.get(str(item.path), len(place)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Workers that get whole modules get those of one folder after the other."""
    if config.getvalue("dist") != "loadfile":
        return None
    from tests.scheduling import LoadFolderScheduling

    return LoadFolderScheduling(config, log)


@pytest.fixture(scope="module", autouse=True)
def _bounded_memory():
    """Compiled programs stay for the modules that follow, until they fill the memory."""
    yield
    if "jax" in sys.modules and psutil.Process().memory_info().rss > _MOST_MEMORY:
        sys.modules["jax"].clear_caches()
        return_freed_memory()


def return_freed_memory() -> None:
    """Returns memory that is no longer used to the system.

    The C library keeps it otherwise: the process stays as large as before, and programs would be
    dropped after every module that follows.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


@pytest.fixture(scope="session")
def paper_policy(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """File of a human policy that knows the paper's four constraints and has learnt nothing."""
    from congrasp.common.config import NetworkConfig, RunConfig
    from congrasp.common.policy import bundle
    from congrasp.common.task.config import TaskConfig
    from congrasp.common.task.constraints import PAPER
    from congrasp.services.train.command import untrained

    file = tmp_path_factory.mktemp("policies") / "paper.safetensors"
    network = NetworkConfig(hidden=(16,), encoder=4)
    bundle.save(untrained(RunConfig(task=TaskConfig(constraints=PAPER), network=network)), file)
    return file


@pytest.fixture(scope="session")
def short_policy(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """File of an untrained policy of the smallest task, whose programs compile soonest."""
    from congrasp.common.config import NetworkConfig, RunConfig
    from congrasp.common.policy import bundle
    from congrasp.common.task.config import TaskConfig
    from congrasp.services.train.command import untrained

    task = TaskConfig(
        constraints=("heading",),
        approach_steps=3,
        hold_steps=2,
        hold_steps_max=2,
        surface_points=64,
    )
    file = tmp_path_factory.mktemp("policies") / "short.safetensors"
    network = NetworkConfig(hidden=(4,), encoder=2)
    bundle.save(untrained(RunConfig(task=task, network=network)), file)
    return file


@pytest.fixture(scope="session")
def mano(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A file of MANO's layout."""
    from tests.mano_file import mano_pickle

    path = tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl"
    path.write_bytes(mano_pickle())
    return path


@pytest.fixture(scope="session")
def shared_objects() -> pathlib.Path:
    """Folder of the 24 scanned objects, which lies beside the repository where it is present."""
    folder = ROOT.parent / "shared" / "objects"
    if not folder.is_dir():
        pytest.skip("the scanned objects are not here (../shared/objects)")
    return folder
