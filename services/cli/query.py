"""`congrasp query`: one query of a policy server, or a latency test."""

import dataclasses
import json
import pathlib
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from congrasp.common.errors import TransportError
from congrasp.common.transport.ports import SERVER_URL
from congrasp.services.cli.console import in_range
from congrasp.services.client.joint_health import joint_health
from congrasp.services.client.policy_client import PolicyClient

if TYPE_CHECKING:
    from congrasp.services.serve.load import Example


@dataclasses.dataclass(frozen=True)
class Query:
    """Query a policy server for one action at the start of an episode, or measure its latency.

    Examples:
      congrasp query --connect tcp/127.0.0.1:7457
      congrasp query --repeat 1000 --concurrency 4 --json
      congrasp query --repeat 4000 --concurrency 200 --rate 2
    """

    connect: str = SERVER_URL
    """Endpoint of the server."""
    name: str = "policy"
    """Name under which the policy is served ('congrasp serve --name')."""
    object_seed: int = 1_000_000
    """Seed of the procedural object and of the heading in the query."""
    repeat: int = 1
    """Total number of queries."""
    concurrency: int = 1
    """Number of concurrent clients, each with a separate connection."""
    states: int = 1
    """Number of states in a query, up to 64; each state gets an answer."""
    rate: float = 0.0
    """Queries per second of each client; with 0 a client sends a query as soon as it has the answer
    to the last one."""
    timeout: float = 1.0
    """Deadline of a query, s."""
    certs: pathlib.Path | None = None
    """Folder of a client's certificate (congrasp certs)."""
    health: bool = False
    """Only check if the server is ready. The exit code is then 0, and 4 if it is not. The numbers
    of several workers are added up."""
    json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Measure the latency and print it as JSON: p50_ms, p99_ms, answers_per_s, failed,
    overloaded."""

    def __call__(self) -> int:
        """Queries the server, and prints the answer or the latency."""
        in_range(1, repeat=self.repeat, concurrency=self.concurrency, states=self.states)
        in_range(0, rate=self.rate)
        if self.health:
            return self._print_health()
        from congrasp.services.serve.load import one_answer

        episode = self._episode()
        with self._client(hand=episode.hand) as client:
            is_single = self.repeat == 1 and self.states == 1
            if is_single and not self.json:
                print(one_answer(client, episode))
                return 0
        return self._print_latency(episode)

    def _client(self, **options: Any) -> PolicyClient:
        """Returns a client of the server."""
        return PolicyClient(
            self.connect, self.name, timeout=self.timeout, certs=self.certs, **options
        )

    def _print_health(self) -> int:
        """Prints the state of the server; returns the exit code."""
        health = joint_health(self.connect, self.name, timeout=self.timeout, certs=self.certs)
        print(json.dumps(health))
        return 0 if health["ready"] else TransportError.exit_code

    def _episode(self) -> "Example":
        """Returns an example episode of the server's hand."""
        from congrasp.services.serve.load import example_episode

        with self._client() as client:
            hand = str(client.wait_until_ready()["hand"])
            return example_episode(self.object_seed, hand)

    def _print_latency(self, episode: "Example") -> int:
        """Measures and prints the latency; returns the exit code."""
        from congrasp.services.serve.load import Load, Target, measure

        target = Target(self.connect, self.name, self.timeout, self.certs)
        load = Load(self.repeat, self.concurrency, self.states, self.rate)
        result = measure(target, episode, load)
        if self.json:
            print(json.dumps(result))
        else:
            print(
                f"{self.repeat} queries of {self.states} state(s) from {self.concurrency} "
                f"client(s): p50 {result['p50_ms']:.2f} ms, p99 {result['p99_ms']:.2f} ms, "
                f"{result['answers_per_s']:.0f} answers/s, {result['failed']:.0f} failed, "
                f"{result['overloaded']:.0f} overloaded"
            )
        return 0 if result["failed"] == 0 else 1


COMMAND = Query
