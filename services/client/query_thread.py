"""Queries to a policy in a thread: a control loop need not wait for them. Needs only NumPy."""

import threading
from typing import NamedTuple

from congrasp.common.errors import TransportError
from congrasp.common.request import GraspRequest
from congrasp.common.runtime import forks
from congrasp.services.client.policy import Answer, Policy, State

_END_TIMEOUT_S = 2.0  # deadline for the end of the thread


class Outcome(NamedTuple):
    """Result of a query."""

    answer: Answer | TransportError
    state_time: float
    """Time of the state of the query, s."""


class _PendingQuery(NamedTuple):
    """A state that waits for the thread."""

    state: State
    time: float
    """Time of the state, s."""


class QueryThread:
    """Queries a policy in a thread: one query at a time, without outcomes of earlier episodes."""

    def __init__(self, policy: Policy):
        self._policy = policy
        self._fork_generation = forks.generation()
        self._changed = threading.Condition()  # guards the following
        self._request: GraspRequest | None = None  # of the current episode
        self._pending: _PendingQuery | None = None
        self._outcome: Outcome | None = None  # until `exchange` returns it
        self._episode = 0  # number of the current episode
        self._is_busy = False  # a query is pending, or the policy is answering it
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, daemon=True, name="guard")
        self._thread.start()

    @property
    def is_busy(self) -> bool:
        """True while a query is pending or being answered."""
        with self._changed:
            return self._is_busy

    def require_same_process(self) -> None:
        """Raises a ForkError in a fork of this process, where the thread does not run."""
        forks.require_same_process(self._fork_generation, "guard")

    def begin(self, request: GraspRequest) -> None:
        """Begins an episode; a pending query is dropped."""
        with self._changed:
            self._episode += 1
            if self._pending is not None:  # else the policy may still be answering a query
                self._is_busy = False
            self._request = request
            self._pending = None
            self._outcome = None

    def exchange(self, state: State, now: float, timeout: float) -> Outcome | None:
        """Queries with a state unless the thread is busy, and waits for an outcome.

        Args:
          state: the state.
          now: time of the state, s.
          timeout: seconds to wait.

        Returns:
          The newest outcome that was not returned before, of this state or of an earlier one; None
          if there is none.
        """
        with self._changed:
            earlier = self._outcome
            self._outcome = None
            if not self._is_busy:
                self._pending = _PendingQuery(state, now)
                self._is_busy = True
                self._changed.notify_all()
            self._changed.wait_for(lambda: self._outcome is not None, timeout)
            outcome = self._outcome or earlier
            self._outcome = None
            return outcome

    def close(self) -> None:
        """Ends the thread, unless a query blocks it, and closes the policy. In a fork it does
        neither: both belong to the process that opened them.
        """
        if self._fork_generation != forks.generation():
            return
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._thread.join(_END_TIMEOUT_S)
        self._policy.close()

    def _work(self) -> None:
        """Answers queries until closed; runs in the thread."""
        answered_episode = 0  # the last episode with an answer
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._pending is not None or self._is_closed)
                if self._is_closed or self._pending is None:
                    return
                query = self._pending
                episode = self._episode
                request = self._request
                self._pending = None
            if episode == answered_episode:
                request = None  # the policy has it already
            answer = self._answer(request, query.state)
            if not isinstance(answer, TransportError):
                answered_episode = episode
            with self._changed:
                self._is_busy = False
                if episode == self._episode:
                    self._outcome = Outcome(answer, query.time)
                self._changed.notify_all()

    def _answer(self, request: GraspRequest | None, state: State) -> Answer | TransportError:
        """Returns the policy's answer, or a TransportError for any failure.

        Args:
          request: begins an episode first; None continues the current one.
          state: state of the query.
        """
        try:
            if request is not None:
                self._policy.reset(request)
            answer = self._policy.act(state)
        except TransportError as error:
            return error
        except Exception as error:
            return TransportError(f"The policy failed: {type(error).__name__}: {error}")
        if not isinstance(answer, Answer):
            return TransportError("The policy did not return an Answer.")
        return answer
