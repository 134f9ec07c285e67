"""Queries to a policy in a thread: a control loop need not wait for them. Needs only NumPy."""

import threading
from typing import NamedTuple

from congrasp.common.errors import TransportError
from congrasp.common.request import GraspRequest
from congrasp.common.runtime import forks
from congrasp.services.client.policy import Answer, Policy, State

_END_S = 2.0  # deadline for the end of the thread, s


class Outcome(NamedTuple):
    """Result of a query."""

    answer: Answer | TransportError
    state_time: float
    """Time of the state of the query, s."""


class _Question(NamedTuple):
    """A state that waits for the thread."""

    state: State
    time: float


class QueryThread:
    """Queries a policy in a thread: one query at a time, without outcomes of earlier episodes."""

    def __init__(self, policy: Policy):
        self._policy = policy
        self._fork_generation = forks.generation()
        self._changed = threading.Condition()
        self._request: GraspRequest | None = None
        self._question: _Question | None = None
        self._outcome: Outcome | None = None
        self._episode = 0
        self._busy = False
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True, name="guard")
        self._thread.start()

    @property
    def is_busy(self) -> bool:
        """True while a query is pending."""
        with self._changed:
            return self._busy

    def require_same_process(self) -> None:
        """Raises a ForkError in a fork of this process, where the thread does not run."""
        forks.require_same_process(self._fork_generation, "guard")

    def begin(self, request: GraspRequest) -> None:
        """Begins an episode."""
        with self._changed:
            self._episode += 1
            self._busy = self._busy and self._question is None
            self._request = request
            self._question = None
            self._outcome = None

    def exchange(self, state: State, now: float, timeout: float) -> Outcome | None:
        """Queries with a state, unless a query is pending, and returns the newest outcome within
        the timeout.

        Args:
          state: the state.
          now: time of the state.
          timeout: seconds to wait.

        Returns:
          An outcome that was not returned before, of this state or of an earlier one; None without
          one.
        """
        with self._changed:
            earlier = self._outcome
            self._outcome = None
            if not self._busy:
                self._question = _Question(state, now)
                self._busy = True
                self._changed.notify_all()
            self._changed.wait_for(lambda: self._outcome is not None, timeout)
            outcome = self._outcome or earlier
            self._outcome = None
            return outcome

    def close(self) -> None:
        """Ends the thread, unless a query blocks it, and closes the policy; a fork leaves both to
        the process that opened them.
        """
        if self._fork_generation != forks.generation():
            return
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(_END_S)
        self._policy.close()

    def _work(self) -> None:
        """Answers queries until closed; runs in the thread."""
        answered_episode = 0  # the last episode with an answer
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._question is not None or self._closed)
                if self._closed or self._question is None:
                    return
                question = self._question
                episode = self._episode
                request = self._request
                self._question = None
            is_first = episode != answered_episode
            answer = self._answer(request if is_first else None, question.state)
            if not isinstance(answer, TransportError):
                answered_episode = episode
            with self._changed:
                self._busy = False
                if episode == self._episode:
                    self._outcome = Outcome(answer, question.time)
                self._changed.notify_all()

    def _answer(self, request: GraspRequest | None, state: State) -> Answer | TransportError:
        """The policy's answer, or a TransportError for any failure.

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
