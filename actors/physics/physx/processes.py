"""A batch of environments in PhysX, distributed over processes."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from congrasp.actors.physics.engine import PhysicsState, ResetState, host_arrays
from congrasp.actors.physics.physx.batch import PhysxPhysics
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.worker_process import Messages, WorkerProcess
from congrasp.common.task.config import TaskConfig

_MIN_BATCH = 32
"""Smallest batch that is distributed: a process starts in about the time of 1,000 control steps."""
_MIN_SHARE = 4
"""Smallest number of environments of a process."""


class PhysxProcesses:
    """A batch of environments in PhysX: this process and others simulate a share of it each. Its
    state is this object; calls mutate it.

    Of N processes, process k simulates environments k, k + N, k + 2N, and so on. The results are
    those of one process, since environments do not depend on each other.
    """

    name = "physx"
    compiled = False

    def __init__(
        self, hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], processes: int
    ):
        """Creates the engine; objects are compiled on first use, and processes start with the
        first batch.

        Args:
          hand: the hand.
          task: timing and collision settings.
          objects: the pool indexed by `ResetState.object_index`.
          processes: most processes, including this one.

        Raises:
          CongraspError: see `PhysxPhysics`.
        """
        self._hand = hand
        self._task = task
        self._objects = objects
        self._most = processes
        self._local = PhysxPhysics(hand, task, objects)
        self._workers: list[WorkerProcess] = []

    def start(self, reset_state: ResetState) -> "PhysxProcesses":
        """Starts environments; see `Physics.start`.

        Raises:
          CongraspError: a process does not start.
        """
        reset_state = host_arrays(reset_state)
        self._set_processes(_processes(len(reset_state.object_index), self._most))
        self._call(_start, reset_state)
        return self

    def reset(self, state: Any, mask: Any, reset_state: ResetState) -> "PhysxProcesses":
        """Restarts the masked environments; see `Physics.reset`."""
        self._call(_reset, np.asarray(mask), host_arrays(reset_state))
        return self

    def step(
        self, state: Any, target: Any, table: Any, force: Any | None = None
    ) -> tuple["PhysxProcesses", PhysicsState]:
        """Simulates one control step; see `Physics.step`. Resets and flags diverged
        environments.
        """
        arrays = [np.asarray(target), np.asarray(table)]
        if force is not None:
            arrays.append(np.asarray(force))
        return self, _merged(self._call(_step, *arrays))

    def replace_objects(self, state: Any, objects: Sequence[GraspObject]) -> "PhysxProcesses":
        """Replaces the objects; see `Physics.replace_objects`."""
        self._objects = objects
        self._distribute(_replace_objects, [[objects]] * (1 + len(self._workers)))
        return self

    def read(self, state: Any) -> PhysicsState:
        """Returns the current state of the environments; see `Physics.read`."""
        return _merged(self._call(_read))

    def close(self) -> None:
        """Ends the processes, and frees the scenes."""
        self._set_processes(1)
        self._local.close()

    def _set_processes(self, count: int) -> None:
        """Starts or ends processes, until there are `count` including this process."""
        while len(self._workers) >= count:
            self._workers.pop().stop()
        running = len(self._workers)
        with self._close_on_errors():
            while 1 + len(self._workers) < count:
                self._workers.append(WorkerProcess(serve))
            # All have started before the first of them reads its message
            for worker in self._workers[running:]:
                worker.send((self._hand, self._task, self._objects))

    def _call(self, call: Callable[..., Any], *arrays: Any) -> list[Any]:
        """Makes a call in each process with its rows of arrays (B, ...) or of reset states."""
        count = 1 + len(self._workers)
        shares = []
        for number in range(count):
            rows = slice(number, None, count)
            shares.append([_rows(array, rows) for array in arrays])
        return self._distribute(call, shares)

    def _distribute(
        self, call: Callable[..., Any], arguments: Sequence[Sequence[Any]]
    ) -> list[Any]:
        """Makes a call in each process; returns the results, first the one of this process.

        Raises:
          CongraspError: a process has ended, or its call raised one.
        """
        with self._close_on_errors():
            for worker, of_worker in zip(self._workers, arguments[1:], strict=True):
                worker.send((call, of_worker))
            results = [call(self._local, *arguments[0])]
            for worker in self._workers:
                results.append(worker.receive())
            for result in results:
                if isinstance(result, _Failure):
                    raise CongraspError(result.text)
        return results

    @contextlib.contextmanager
    def _close_on_errors(self) -> Iterator[None]:
        """Closes the engine on errors, since the next call would receive the results of this one.

        Raises:
          CongraspError: a process has ended.
        """
        try:
            yield
        except (EOFError, OSError):
            self.close()
            raise CongraspError(
                "A process of the 'physx' engine cannot start, or has ended.",
                "See its output above; without any, the system may have ended it for lack of "
                "memory.",
            ) from None
        except BaseException:
            self.close()
            raise


class _Failure(NamedTuple):
    """CongraspError of a call."""

    text: str


def serve(caller: Messages) -> None:
    """Makes the calls of another process until that process ends.

    The first message has the arguments of the engine.
    """
    with contextlib.suppress(EOFError, OSError):
        engine = PhysxPhysics(*caller.receive())
        while True:
            call, arguments = caller.receive()
            try:
                result = call(engine, *arguments)
            except CongraspError as error:
                result = _Failure(str(error))
            caller.send(result)


def _start(engine: PhysxPhysics, reset_state: ResetState) -> None:
    engine.start(reset_state)


def _reset(engine: PhysxPhysics, mask: np.ndarray, reset_state: ResetState) -> None:
    engine.reset(engine, mask, reset_state)


def _step(engine: PhysxPhysics, *arrays: np.ndarray) -> PhysicsState:
    return engine.step(engine, *arrays)[1]


def _replace_objects(engine: PhysxPhysics, objects: Sequence[GraspObject]) -> None:
    engine.replace_objects(engine, objects)


def _read(engine: PhysxPhysics) -> PhysicsState:
    return engine.read(engine)


def _processes(batch: int, most: int) -> int:
    """Number of processes for a batch of environments."""
    if batch < _MIN_BATCH:
        return 1
    return min(most, batch // _MIN_SHARE)


def _rows(array: Any, rows: slice) -> Any:
    """Rows of an array, or of each array of a reset state."""
    if isinstance(array, ResetState):
        return ResetState(*(field[rows] for field in array))
    return array[rows]


def _merged(states: Sequence[PhysicsState]) -> PhysicsState:
    """Joins the states of the processes' environments; the occupancy is zero in all of them."""
    fields = {}
    for name in PhysicsState._fields:
        shares = [getattr(state, name) for state in states]
        if name == "occupancy":
            fields[name] = shares[0]
            continue
        batch = sum(len(share) for share in shares)
        fields[name] = np.empty((batch, *shares[0].shape[1:]), shares[0].dtype)
        for number, share in enumerate(shares):
            fields[name][number :: len(shares)] = share
    return PhysicsState(**fields)
