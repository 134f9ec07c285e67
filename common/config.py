"""All settings of a run as frozen dataclasses; the string under a field is its help on the command
line.

A run is described by one `RunConfig`. It is sent as JSON: the learner stores it in the run
directory and sends it to every actor that connects. An actor therefore needs no argument but an
address.
"""

import dataclasses
import hashlib
import json
import math
from typing import Annotated, Any, Literal

import tyro

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import file_name
from congrasp.common.io.records import record_of
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.task.config import RewardWeights, TaskConfig

MetricWriter = Literal["tensorboard", "wandb", "wandb-offline"]
"""Additional metric writers of a learner, alongside the recordings."""


Split = Literal["all", "training", "held-out"]
"""Split of the constraint sets."""


@dataclasses.dataclass(frozen=True)
class ObjectsConfig:
    """Objects of a run."""

    families: tuple[str, ...] = ()
    """Families of the procedural generator, or groups of families (basic, household, all); basic if
    empty.
    """
    count: int = 64
    """Number of procedural objects of each actor."""
    seed: int = 0
    """Seed of the first procedural object. Each actor adds an offset, so that actors have different
    objects. Evaluation uses seeds from one million upward.
    """
    folder: str = ""
    """Folder of imported objects to use instead of procedural objects."""
    constraints: str = ""
    """Folder of constraint sets for the objects of --objects.folder, such as captured ones
    ('congrasp constraints import'). Training samples headings, reference poses and trajectories
    from them. Objects without a set are left out."""
    split: Split = "training"
    """Part of the constraint sets: training, held-out, or all."""
    procedural: int = 0
    """Number of procedural objects in addition to those of the folder."""
    folder_share: float = 0.0
    """Share of the episodes with an object of the folder, if there are also procedural objects.
    With 0 all objects are equally likely."""
    renew_every: int = 0
    """Number of rollouts after which an actor replaces its procedural objects by those of the next
    seeds and restarts its episodes; 0 keeps the objects. The replacement takes as long as the
    generation at the start."""
    by_failure: bool = False
    """Samples objects by the success of the actor's episodes: objects with an uncertain outcome up
    to twice as often, and objects that almost always succeed or almost always fail down to half as
    often. This also changes the share of the folder's objects."""

    def __post_init__(self) -> None:
        """Raises a CongraspError for constraint sets without objects."""
        if self.constraints and not self.folder:
            raise CongraspError(
                "Constraint sets need their objects.", "Pass the objects with --objects.folder."
            )


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the networks of the policy and the critic (they share no weights)."""

    hidden: tuple[int, ...] = (512, 256, 128)
    """Numbers of units in the layers of the main network."""
    encoder: int = 64
    """Number of units in the encoder of each optional constraint."""
    points: tuple[int, ...] = (64, 128)
    """Numbers of units in the layers that encode each point of a camera's cloud, before the maximum
    over the points.
    """
    initial_std: float = 0.6
    """Initial standard deviation of the action, in units of the action."""
    privileged_critic: bool = True
    """Gives the critic inputs that the policy does not observe: the true parameters of the episode,
    such as the object's mass, and the true state if the policy has sensors
    (`common.task.privileged`)."""


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Decoupled PPO (Hilton et al. 2021, arXiv 2110.00641) with adaptive-KL learning rate."""

    epochs: int = 4
    """Passes over the batch."""
    minibatches: int = 16
    """Minibatches in one pass."""
    clip: float = 0.2
    """Clip of pi/pi_proximal."""
    importance_max: float = 4.0
    """Truncation of pi_proximal/pi_behaviour."""
    decoupled: bool = True
    """Clips around the policy at the start of the update; if false, around the behaviour policy, as
    in standard PPO.
    """
    gamma: float = 0.98
    """Discount."""
    gae_lambda: float = 0.95
    """Lambda of the generalised advantage estimate."""
    bootstrap_truncated: bool = True
    """Bootstraps from the critic if the time limit ends an episode while the object is held; if
    false, from zero.
    """
    learning_rate: float = 5e-4
    """Initial learning rate of Adam. A run with --initial starts with a tenth of it."""
    learning_rate_range: tuple[float, float] = (1e-5, 3e-3)
    """Bounds of the adaptive learning rate."""
    kl_target: float = 0.012
    """Target of the KL divergence: the learning rate falls above twice this value and rises below
    half of it.
    """
    settling: float = 0.0
    """Share of the run's updates, at the end of the run, that let the policy converge: `kl_target`
    falls linearly to a tenth, and the standard deviation of the action falls to `final_std`. 0
    changes neither."""
    final_std: float = 0.1
    """Standard deviation of the action at the end of `settling`, in units of the action. With n
    updates left, it is capped at std (final_std / std)^(1/n), a geometric decay. A smaller standard
    deviation is not changed; 0 sets no cap."""
    least_std: float = 0.0
    """Smallest standard deviation of the action before `settling`, in units of the action. Each
    update raises a smaller standard deviation to this value; 0 sets no minimum."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    value_coefficient: float = 0.5
    """Weight of the value loss."""
    max_grad_norm: float = 1.0
    """Global norm at which gradients are clipped."""
    reward_scale: float = 0.1
    """Factor on rewards before returns are computed."""

    def kl_target_at(self, version: int, updates: int) -> float:
        """Returns the KL target of the update of this version, in a run of `updates` updates."""
        return self.kl_target * (1.0 - 0.9 * min(max(self._settled(version, updates), 0.0), 1.0))

    def noise_kept_at(self, version: int, updates: int) -> float:
        """Largest share k of log(std / final_std) that the update of this version keeps; infinity
        before `settling`.

        With n updates left k = 1 - 1/n. After j of m updates std is at most std_0^(1 - j/m)
        final_std^(j/m).
        """
        if self.final_std <= 0.0 or not self.settling or self._settled(version, updates) < 0.0:
            return math.inf
        return 1.0 - 1.0 / max(updates - version, 1)

    def least_std_at(self, version: int, updates: int) -> float:
        """Returns the minimum of the action's standard deviation in the update of this version; 0
        during `settling`.
        """
        settles = bool(self.settling) and self._settled(version, updates) >= 0.0
        return 0.0 if settles else self.least_std

    def _settled(self, version: int, updates: int) -> float:
        """Share of `settling` completed before the update of this version; negative before it
        begins.
        """
        return (
            1.0 - (updates - version) / (self.settling * updates)
            if self.settling and updates
            else 0.0
        )


@dataclasses.dataclass(frozen=True)
class DistillConfig:
    """Distillation of a policy into another (`learner.algorithms.distill`)."""

    teacher: str = ""
    """The teacher: a policy file, or the hand of a pretrained policy."""
    epochs: int = 2
    """Passes over the batch."""
    minibatches: int = 16
    """Minibatches in one pass."""
    learning_rate: float = 1e-3
    """Initial learning rate of Adam; it falls linearly to a fiftieth over the run's updates."""
    max_grad_norm: float = 1.0
    """Global norm at which gradients are clipped."""


@dataclasses.dataclass(frozen=True)
class CurriculumConfig:
    """The paper's two phases: first fixed objects, then movable objects with larger weights of the
    constraints.
    """

    stationary_updates: int = 0
    """Number of updates during which objects are fixed and the table stays."""
    ramp: tuple[int, int] = (0, 0)
    """First and last update of a linear change of the reward weights, from `task.reward` to
    `curriculum.reward`. If both are equal, the weights do not change.
    """
    reward: RewardWeights = RewardWeights()
    """Weights of the reward terms at the end of the ramp."""

    @property
    def ramped(self) -> bool:
        """True if the weights change."""
        return self.ramp[0] < self.ramp[1]

    def stationary(self, version: int) -> bool:
        """True if objects are fixed under the policy of this version."""
        return version < self.stationary_updates

    def weights(self, first: RewardWeights, version: int) -> RewardWeights:
        """Returns the reward weights under the policy of this version; `first` are those of the
        task.
        """
        if not self.ramped:
            return first
        begin, end = self.ramp
        share = min(max((version - begin) / (end - begin), 0.0), 1.0)
        return RewardWeights(
            **{
                field.name: (1 - share) * getattr(first, field.name)
                + share * getattr(self.reward, field.name)
                for field in dataclasses.fields(RewardWeights)
            }
        )


@dataclasses.dataclass(frozen=True)
class NamedInput:
    """A file or folder that a run names, and its content (`common.named_inputs`)."""

    kind: str
    """One of `common.named_inputs.KINDS`."""
    path: str
    """Absolute path on the learner's machine."""
    digest: str
    """Sixteen hex digits of the SHA-256 of its content."""


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """One training run."""

    name: str = "run"
    """Name of the run, which is a part of every message's key."""
    seed: int = 0
    """Seed of networks, minibatches and environments."""
    environments: int = 64
    """Number of environments of each actor."""
    rollout_steps: int = 75
    """Number of control steps of each environment in a rollout."""
    rollouts_per_update: int = 2
    """Number of rollouts in the batch of an update, for each learner rank."""
    max_staleness: int = 1
    """Largest lag (eta) of a rollout: the number of versions between the policy that made it and
    the policy that is updated with it."""
    updates: int = 1000
    """Number of updates of the run."""
    physics: PhysicsName = "auto"
    """Physics engine of the actors."""
    half_observations: bool = True
    """Rounds observations to float16, for the policy's actions and for the messages."""
    checkpoint_every: int = 25
    """Number of updates between two checkpoints."""
    write_ahead: bool = True
    """Writes every rollout to disk before it is acknowledged, and keeps it until a checkpoint
    contains the update that used it. A resumed run then uses these rollouts, whichever process was
    killed. If false, a killed learner loses the rollouts since the last checkpoint."""
    collapse_patience: int = 60
    """Number of consecutive updates with hardly any contact, or with less than half of the best
    success, after which the run stops; 0 switches this off.
    """
    episode_every: int = 10
    """Smallest number of an actor's rollouts between two episodes that are published for logs. It
    may be more, because an episode may extend over several rollouts."""
    log_rollout_every: int = 20
    """Number of an actor's rollouts between two that are published for logs; 1 publishes all of
    them, 0 none."""
    log_rollout_worlds: int = 4
    """Number of environments of a rollout that are published for logs; 0 publishes all of them."""
    task: TaskConfig = TaskConfig()
    """The task."""
    curriculum: CurriculumConfig = CurriculumConfig()
    """Changes of the task during training."""
    objects: ObjectsConfig = ObjectsConfig()
    """The objects."""
    network: NetworkConfig = NetworkConfig()
    """The networks."""
    algorithm: str = "ppo"
    """Name of the learner's algorithm."""
    ppo: PPOConfig = PPOConfig()
    """The algorithm's hyperparameters."""
    distill: DistillConfig = DistillConfig()
    """Hyperparameters of distillation."""
    inputs: Annotated[tuple[NamedInput, ...], tyro.conf.Fixed, tyro.conf.Suppress] = ()
    """Content of the files and folders that the run names; written by the learner."""


def to_json(config: Any) -> str:
    """Returns a configuration dataclass as JSON text."""
    return json.dumps(dataclasses.asdict(config), indent=2, sort_keys=True)


def run_config_from_json(text: str | bytes) -> RunConfig:
    """Parses the JSON text of a `RunConfig`; errors name unknown keys and wrong types."""
    try:
        fields = json.loads(text, parse_constant=_no_constant)
        if not isinstance(fields, dict):
            raise ValueError("it is not an object")
    except (ValueError, RecursionError) as error:  # not UTF-8, or nested too deep
        raise CongraspError(
            f"The configuration is not JSON: {error}.", "Regenerate it with 'congrasp train'."
        ) from None
    if isinstance(ppo := fields.get("ppo"), dict):  # files of earlier versions
        fields |= {
            name: ppo.pop(name) for name in ("rollouts_per_update", "max_staleness") if name in ppo
        }
    try:
        config = record_of(RunConfig, fields)
    except ValueError as error:
        raise CongraspError(
            f"The configuration does not match this version of congrasp: {error}.",
            "Use the version that wrote it, or start a new run.",
        ) from None
    file_name(config.name, "a run")
    return config


def _no_constant(name: str) -> float:
    raise ValueError(f"it contains {name}")


def digest(config: Any) -> str:
    """Sixteen hex digits that identify a configuration's content."""
    return hashlib.sha256(to_json(config).encode()).hexdigest()[:16]
