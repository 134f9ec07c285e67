"""`congrasp reproduce`: the paper's tables, from training to comparison."""

import dataclasses
import pathlib
import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from congrasp.actors.physics import PhysicsName
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.services.cli.console import in_range, tracked
from congrasp.services.ops.lifetime import command

if TYPE_CHECKING:
    from congrasp.services.evaluate.lineup import Entrant, PolicyKey
    from congrasp.services.evaluate.paper.evaluation import PartSettings

_RUNS_FOLDER = "policies"
"""Folder of trainings within the output folder."""


class _Size(NamedTuple):
    """Default size of an evaluation."""

    episodes: int
    """Episodes of each row."""
    pool: int
    """Procedural objects."""
    many: int
    """Episodes of the table of many objects, for each episode of a row."""


_FULL = _Size(episodes=1000, pool=64, many=50)
_QUICK = _Size(episodes=48, pool=24, many=2)


@dataclasses.dataclass(frozen=True)
class Reproduce:
    """Reproduce the paper's tables: train missing policies, evaluate, and write a page, JSON and
    LaTeX.

    On a GPU this trains the full system for each hand, and then the baselines and ablations that
    are trained. Each training is a separate run of 'congrasp train' in OUT/policies; a failure does
    not stop the others. Then all tables are evaluated. The page shows every figure with its
    interval, the paper's figure and the difference, and lists figures that are not comparable with
    the reason. Repeat an interrupted command to resume it: trainings resume from their last
    checkpoint, and finished tables are repeated only if the policy or the settings changed.

    Examples:
      congrasp reproduce --quick
      congrasp reproduce --captured grab oakink dexycb
    """

    out: pathlib.Path = pathlib.Path("reproduction")
    """Folder for reproduction.html, reproduction.json and tables.tex, and for runs, rows and
    pictures.
    """
    quick: bool = False
    """Use the pretrained policies without any training, and evaluate 48 episodes per row. This
    takes minutes on two CPU cores.
    """
    hands: tuple[str, ...] = ()
    """Hands whose full system is evaluated; the tables of a single hand use the first of them. By
    default all hands with a pretrained policy."""
    methods: tuple[str, ...] = ()
    """Methods to compare with the full system: pd, graspxl, dgrasp, no-dynamic-center,
    no-feedforward, two-phase, single-stage; by default all."""
    policy: tuple[str, ...] = ()
    """Policies to use instead of training them, as for 'congrasp evaluate --policy'."""
    captured: tuple[pathlib.Path, ...] = ()
    """Folders of captured data sets, each with the folders 'objects' and 'constraints' that
    'congrasp constraints import' makes; most of the paper's tables need them."""
    episodes: int = 0
    """Number of episodes per row; 0 uses 1,000, or 48 with --quick."""
    pool: int = 0
    """Number of procedural objects per row; 0 uses 64, or 24 with --quick."""
    physics: PhysicsName = "auto"
    """Engine; auto takes warp on an NVIDIA GPU and native (MuJoCo C) on a CPU."""
    seed: int = 0
    """Seed of constraints and episodes."""
    training: str = ""
    """Further options of every 'congrasp train', as one string."""
    patience: int = 240
    """Minutes after which a training is stopped. The next 'congrasp reproduce' resumes it."""

    def __call__(self) -> int:
        """Trains, evaluates, and prints a summary."""
        from congrasp.common.policy.pretrained import pretrained_hands
        from congrasp.services.evaluate.paper.comparison import summary
        from congrasp.services.evaluate.paper.page import JSON, LATEX, PAGE, page_template
        from congrasp.services.evaluate.paper.parts import BASELINES, required_policies
        from congrasp.services.evaluate.paper.reproduction import Request, reproduce
        from congrasp.services.train.reproduction import (
            PolicyRequest,
            get_policies,
            policies_to_train,
        )

        in_range(0, episodes=self.episodes, pool=self.pool)
        in_range(1, patience=self.patience)
        hands = tuple(dict.fromkeys(self.hands)) or tuple(pretrained_hands())
        methods = self.methods or BASELINES
        _check_names(hands, methods)
        policy_request = PolicyRequest(
            hands=hands,
            methods=methods,
            given=_given_policies(self.policy, required_policies(hands, methods)),
            pretrained=self.quick,
            runs=self.out / _RUNS_FOLDER,
            options=tuple(shlex.split(self.training)),
            timeout_s=60.0 * self.patience,
        )
        request = Request(
            out=self.out,
            hands=hands,
            methods=methods,
            captured=self.captured,
            noise=not self.quick,
            command=self._command(),
            settings=self._settings(),
        )
        _check_device([policy.name for policy in policies_to_train(policy_request)])
        page_template()  # fails before the trainings if a package is missing
        with tracked() as track:
            # First: trainings have the whole device memory until this process has an engine.
            policies = get_policies(policy_request, track)
            for failure in policies.failures:
                print(failure, flush=True)
            reproduction = reproduce(request, policies, track, lambda text: print(text, flush=True))
        print(summary(reproduction.cells))
        print(f"The page is {self.out / PAGE}, next to {JSON} and {LATEX}.")
        return 1 if reproduction.failures else 0

    def _settings(self) -> "PartSettings":
        """Numbers of episodes and objects, engine and seed."""
        from congrasp.services.evaluate.paper.evaluation import PartSettings

        size = _QUICK if self.quick else _FULL
        episodes = self.episodes or size.episodes
        return PartSettings(
            episodes=episodes,
            pool=self.pool or size.pool,
            many=size.many * episodes,
            physics=self.physics,
            seed=self.seed,
        )

    def _command(self) -> str:
        """The command line, with the options that are set."""
        defaults = vars(Reproduce())
        changed = {name: value for name, value in vars(self).items() if value != defaults[name]}
        return shlex.join(command("congrasp", "reproduce", **changed))


def _check_names(hands: Sequence[str], methods: Sequence[str]) -> None:
    """Raises a CongraspError for an unknown hand or method."""
    from congrasp.services.evaluate.paper.parts import BASELINES

    for name in hands:
        if get_hand(name).name != name:
            raise CongraspError(
                f"'{name[:60]}' is no hand's name.", "Choose from 'congrasp hands list'."
            )
    unknown = set(methods) - set(BASELINES)
    if unknown:
        raise CongraspError(
            f"There is no method '{min(unknown)}'.", f"Choose from: {', '.join(BASELINES)}."
        )


def _given_policies(
    texts: tuple[str, ...], needed: "list[PolicyKey]"
) -> "dict[PolicyKey, Entrant]":
    """Returns the policies of --policy by hand and method; raises a CongraspError for one that no
    table needs.
    """
    from congrasp.services.evaluate.lineup import read_entrants

    entrants = {entrant.key: entrant for entrant in read_entrants(texts)}
    for policy, entrant in entrants.items():
        if policy not in needed:
            raise CongraspError(
                f"The policy {entrant.file.name} is of the hand '{policy.hand}' and the method "
                f"'{policy.method}'.",
                "Name that hand with --hands, the first one for methods, or leave the policy out.",
            )
    return entrants


def _check_device(names: list[str]) -> None:
    """Raises a CongraspError if policies must be trained and there is no GPU."""
    from congrasp.services.train import accelerators

    if names and accelerators.detect()[0] == "cpu":
        raise CongraspError(
            f"{', '.join(names)} must be trained first, and this machine has no GPU.",
            "Use --quick, which takes the pretrained policies, or name policies with --policy.",
        )


COMMAND = Reproduce
