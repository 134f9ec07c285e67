"""Policies of a reproduction: given ones, pretrained ones, and those that it trains."""

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence

from congrasp.common.errors import CongraspError
from congrasp.common.policy.pretrained import pretrained_file
from congrasp.common.task.methods import get_method
from congrasp.services.evaluate.experiment import Track
from congrasp.services.evaluate.lineup import Entrant, PolicyKey, read_entrant
from congrasp.services.evaluate.paper.parts import BASELINES, required_policies
from congrasp.services.evaluate.paper.reproduction import AvailablePolicies, Training
from congrasp.services.train import background
from congrasp.services.train.presets import FULL


@dataclasses.dataclass(frozen=True)
class PolicyRequest:
    """Policies requested for a reproduction, and how to get them."""

    hands: tuple[str, ...]
    """Hands; the first is that of all methods but the full system."""
    methods: tuple[str, ...]
    """Methods compared with the full system."""
    given: Mapping[PolicyKey, Entrant]
    """Policies that need no training."""
    pretrained: bool
    """Uses pretrained policies instead of training."""
    runs: pathlib.Path
    """Folder of all trainings."""
    options: tuple[str, ...] = ()
    """Further options of trainings."""
    timeout_s: float = 14400.0
    """Limit of each training, s."""

    def run_dir(self, policy: PolicyKey) -> pathlib.Path:
        """Run directory of a policy's training."""
        return self.runs / policy.name


def policies_to_train(request: PolicyRequest) -> list[PolicyKey]:
    """Returns the policies that would have to be trained."""
    if request.pretrained:
        return []
    missing = []
    for policy in required_policies(request.hands, request.methods):
        if get_method(policy.method).learns and _policy_file(request, policy) is None:
            missing.append(policy)
    return missing


def get_policies(request: PolicyRequest, track: Track) -> AvailablePolicies:
    """Trains missing policies and reads all; a failure does not stop the rest.

    Raises:
      CongraspError: a policy file cannot be read.
    """
    failures = train_all(request, policies_to_train(request), track)
    entrants: dict[PolicyKey, Entrant] = {}
    absent: dict[PolicyKey, str] = {}
    for policy in required_policies(request.hands, request.methods):
        entrant = _entrant(request, policy)
        if entrant is not None:
            entrants[policy] = entrant
        elif policy in failures:
            absent[policy] = failures[policy]
        elif request.pretrained:
            absent[policy] = "not trained with --quick"
        else:
            absent[policy] = "it was not trained"
    for method in BASELINES:
        if method not in request.methods:
            absent[PolicyKey(request.hands[0], method)] = "not requested"
    return AvailablePolicies(
        entrants, absent, _trainings(request, list(entrants)), list(failures.values())
    )


def train_all(
    request: PolicyRequest, policies: Sequence[PolicyKey], track: Track
) -> dict[PolicyKey, str]:
    """Trains policies in turn, each in a separate run, resuming from its last checkpoint if there
    is one.

    Returns:
      Reasons for failed trainings; the others succeeded.
    """
    failures: dict[PolicyKey, str] = {}
    for policy in policies:
        run_dir = request.run_dir(policy)
        track(f"Training {policy.name} (log: {run_dir}.log)", None)
        try:
            background.train_in_background(
                run_dir, training_options(policy), request.options, patience=request.timeout_s
            )
        except CongraspError as error:
            failures[policy] = str(error)
    return failures


def training_options(policy: PolicyKey) -> list[str]:
    """Options of `congrasp train` for a policy's run."""
    options = ["--preset", FULL, "--hand", policy.hand]
    if policy.method != "ours":
        options += ["--method", policy.method]
    return options


def _policy_file(request: PolicyRequest, policy: PolicyKey) -> pathlib.Path | None:
    """Returns a policy's file, if it exists."""
    if policy in request.given:
        return request.given[policy].file
    if request.pretrained and policy.method == "ours":
        return pretrained_file(policy.hand)
    return background.finished_policy(request.run_dir(policy))


def _entrant(request: PolicyRequest, policy: PolicyKey) -> Entrant | None:
    """Reads a policy, if it exists; a method without learning uses the full system's hand and
    geometry.
    """
    if policy in request.given:
        return request.given[policy]
    source = policy
    if not get_method(policy.method).learns:
        source = PolicyKey(policy.hand, "ours")
    file = _policy_file(request, source)
    return None if file is None else read_entrant(file, policy.method)


def _trainings(request: PolicyRequest, policies: Sequence[PolicyKey]) -> dict[PolicyKey, Training]:
    """Returns the finished trainings of policies."""
    trainings = {}
    for policy in policies:
        run_dir = request.run_dir(policy)
        seconds = background.training_seconds(run_dir)
        if seconds:
            trainings[policy] = Training(run_dir, seconds)
    return trainings
