"""Computes with every entry of the library under a setting of its process, and prints digests.

    python -m tests.settings_process POLICY SETTING...

The digests are of exact results; the last line says which settings of the process have changed.
"""

import concurrent.futures
import contextlib
import gc
import hashlib
import itertools
import locale
import logging
import multiprocessing
import os
import pathlib
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

VARIABLES = tuple(os.environ)
SHORT = {
    "objects": 2,
    "physics": "native",
    "approach_steps": 3,
    "hold_steps": 2,
    "hold_steps_max": 2,
    "constraints": ("heading",),
    "surface_points": 64,
}


def with_jax(**values: Any) -> Callable[[], None]:
    """Returns a function that changes JAX's configuration."""

    def change() -> None:
        for name, value in values.items():
            jax.config.update(f"jax_{name}", value)

    return change


WIDE = {"enable_x64": True}
STRICT = {"numpy_dtype_promotion": "strict", "numpy_rank_promotion": "raise"}
CHECKED = {"debug_nans": True, "debug_infs": True, "check_tracer_leaks": False}
RANDOM = {"default_prng_impl": "rbg", "threefry_partitionable": False}
MATMUL = {"default_matmul_precision": "bfloat16"}
EAGER = {"disable_jit": True}


def warnings_as_errors() -> None:
    """Turns all warnings into errors."""
    warnings.simplefilter("error")


def numpy_errors() -> None:
    """Turns all of NumPy's floating-point conditions into errors."""
    np.seterr(all="raise")


def print_options() -> None:
    """Shortens all printed arrays."""
    np.set_printoptions(precision=1, threshold=2)


def everything() -> None:
    """Changes all settings."""
    with_jax(**WIDE, **STRICT, **CHECKED, **RANDOM, **MATMUL, **EAGER)()
    numpy_errors()
    print_options()
    warnings_as_errors()


SETTINGS: dict[str, Callable[[], None]] = {
    "plain": lambda: None,
    "wide": with_jax(**WIDE),
    "strict": with_jax(**STRICT),
    "checked": with_jax(**CHECKED),
    "random": with_jax(**RANDOM),
    "matmul": with_jax(**MATMUL),
    "eager": with_jax(**EAGER),
    "numpy": numpy_errors,
    "print": print_options,
    "warnings": warnings_as_errors,
    "everything": everything,
}


def digest(*arrays: Any) -> str:
    """Short hash of arrays and their types."""
    parts = [np.ascontiguousarray(array) for array in arrays]
    text = b"".join(str(part.dtype).encode() + part.tobytes() for part in parts)
    return hashlib.sha256(text).hexdigest()[:12]


def act(policy_file: str) -> str:
    """Two actions of a policy in this process."""
    import congrasp

    policy = congrasp.load_policy(policy_file)
    angles = np.linspace(0.0, 6.2, 256)
    points = np.stack([0.03 * np.cos(angles), 0.03 * np.sin(angles), 0.01 * angles - 0.03], -1)
    q = np.array(policy.metadata()["open_pose"])
    level = np.array([1.0, 0.0, 0.0, 0.0])
    object_position = np.array([0.0, 0.0, 0.05])
    request = congrasp.GraspRequest(
        {"heading": {"position": np.zeros(3), "direction": (0.0, 0.0, -1.0)}},
        surface=points,
        q=q,
        wrist=(np.array([0.0, 0.0, 0.2]), np.array([0.0, 0.7071068, 0.7071068, 0.0])),
        object_pose=(object_position, level),
    )
    policy.reset(request)
    state = {
        "q": q,
        "u": np.zeros(6),
        "object_position": object_position,
        "object_quaternion": level,
    }
    answers = [policy.act(state), policy.act(state)]
    return digest(*itertools.chain(*(answer[:3] for answer in answers)))


def act_in_thread(policy_file: str) -> str:
    """The actions of `act` in another thread."""
    with concurrent.futures.ThreadPoolExecutor(1) as threads:
        return threads.submit(act, policy_file).result()


def step(policy_file: str) -> str:
    """An episode of the environment."""
    import congrasp

    envs = congrasp.make_vec(num_envs=2, **SHORT)
    arrays = [envs.reset(seed=1)[0]]
    actions = np.full(envs.action_space.shape, 0.5)
    for _ in range(5):
        arrays += envs.step(actions)[:4]
    envs.close()
    return digest(*arrays)


def grasp(policy_file: str) -> str:
    """A grasp of a generated object."""
    import congrasp
    from tests.short_grasps import short_grasps

    with short_grasps():
        motion = congrasp.grasp("box:1", policy=policy_file, heading="above", attempts=2).motion
    return digest(motion.joint_position, motion.object_position)


def evaluate(policy_file: str) -> str:
    """A row of an evaluation."""
    from congrasp.common.objects import procedural
    from congrasp.common.policy import bundle
    from congrasp.services.evaluate.experiment import Experiment, Variation

    policy = bundle.load(policy_file)
    objects = procedural.generate_many(1, 0, ("box",))
    experiment = Experiment(
        policy, objects, episodes=2, batch=2, hold=policy.task.hold_steps, measured=False
    )
    (result,) = experiment.run([Variation("heading")])
    return digest(*[result.sample.values[name] for name in sorted(result.sample.values)])


ENTRIES = {
    "act": act,
    "act_in_thread": act_in_thread,
    "step": step,
    "grasp": grasp,
    "evaluate": evaluate,
}


def settings_of_process() -> dict[str, Any]:
    """Settings that belong to the caller."""
    return {
        "numpy": np.geterr(),
        "print": np.get_printoptions(),
        "warnings": [*warnings.filters],
        "environment": {name: os.environ.get(name) for name in VARIABLES},
        "jax": {name: getattr(jax.config, name, None) for name in jax.config.values},
        "signals": [signal.getsignal(number) for number in sorted(signal.valid_signals())],
        "hooks": (sys.excepthook, sys.unraisablehook, threading.excepthook),
        "logging": (logging.root.level, [*logging.root.handlers], logging.raiseExceptions),
        "places": (pathlib.Path.cwd(), [*sys.path], locale.setlocale(locale.LC_ALL)),
        "interpreter": (sys.getrecursionlimit(), sys.getswitchinterval(), gc.isenabled()),
        "processes": multiprocessing.get_start_method(allow_none=True),
    }


@contextlib.contextmanager
def restored() -> Iterator[None]:
    """Context at whose end all settings are those of its beginning."""
    before = settings_of_process()["jax"]
    with warnings.catch_warnings(), np.errstate(), np.printoptions():
        yield
    for name, value in before.items():
        if getattr(jax.config, name, None) != value:
            jax.config.update(name, value)


def compute(setting: str, policy_file: str) -> None:
    """Prints a line for each entry under a setting, and one of the settings that have changed."""
    SETTINGS[setting]()
    before = settings_of_process()
    for name, entry in ENTRIES.items():
        print(name, entry(policy_file), flush=True)
    after = settings_of_process()
    # Other libraries add filters when they are imported; the caller's must follow
    after["warnings"] = after["warnings"][-len(before["warnings"]) :]
    print("changed", [name for name in before if before[name] != after[name]])


def main(policy_file: str, *settings: str) -> None:
    """Computes under one setting after the other."""
    for setting in settings:
        with restored():
            compute(setting, policy_file)


if __name__ == "__main__":
    main(*sys.argv[1:])
