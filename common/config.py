"""Everything that can be set, as frozen dataclasses; the string under a field is its help on the command line.

A run is described by one `RunConfig`. It travels as JSON: the learner keeps it in the run directory and hands it to
every actor that connects, so that an actor needs no other argument than an address.
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import dacite
import jax
from typing_extensions import Doc

from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import CONTACT_TIME
from congrasp.common.io.inputs import file_name
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.task.constraints import CONSTRAINTS, OURS, PAPER
from congrasp.common.task.reward import GRASP

MetricWriter = Literal["tensorboard", "wandb", "wandb-offline"]
"""Where else a learner's metrics are written, beside the recordings."""


def _declared(fields: Iterable[tuple[str, float, str]]) -> Any:
    """A frozen dataclass of numbers that are declared elsewhere: name, default, and the text that documents them."""
    made = [(name, Annotated[float, Doc(text)], dataclasses.field(default=value)) for name, value, text in fields]
    return dataclasses.make_dataclass("Declared", made, frozen=True)


_Weights: Any = _declared(
    (
        *(term[:3] for term in GRASP),
        *(weight for constraint in CONSTRAINTS for weight in constraint.weights),
    )
)
_Shares: Any = _declared(
    (
        (f"p_{c.name}", 0.5, f"Probability that an episode has the constraint '{c.name}', where the object allows it.")
        for c in CONSTRAINTS
        if c.optional
    ),
)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RewardWeights(_Weights):
    """Weights of all terms of the reward, in units of reward per control step: the grasp's, and each constraint's."""


@dataclasses.dataclass(frozen=True)
class ControlConfig:
    """How actions become joint targets (paper, section Control Space)."""

    finger_scale: float = 0.1
    """alpha_f, rad per unit of action and control step."""
    wrist_position_scale: float = 0.02
    """alpha_w of the three slides, m per unit of action."""
    wrist_rotation_scale: float = 0.1
    """alpha_w of the three hinges, rad per unit of action."""
    guidance_position_limit: float = 0.04
    """The wrist's target is at most this far ahead of it, m: at kp/kv = 20/s a speed of 0.8 m/s."""
    approach_position_limit: float = 0.02
    """The same as long as the table is there: 0.4 m/s, no faster than a reach hands over."""
    closing_position_limit: float = 0.015
    """The same within `closing_distance` of the object, as long as the table is there: 0.3 m/s."""
    closing_distance: float = 0.04
    """Metres between the hand's keypoints and the object within which it closes in slowly."""
    guidance_rotation_limit: float = 0.3
    """The wrist's target is at most this far ahead of it, rad: 5 rad/s."""
    wrist_acceleration: float = 15.0
    """Greatest acceleration that the wrist's servos give it, m/s^2; by its inertia their greatest force, too.
    0: any."""
    wrist_angular_acceleration: float = 150.0
    """The same about its hinges, rad/s^2."""
    hold_acceleration: float = 1 / 3
    """Share of both that is left when the table is gone, but for what slows the wrist down: it trembles less so."""
    load_rate: float = 60.0
    """Inverse time constant (1/s) of the observer of the wrist's load, which its targets carry when the table is gone,
    so that the limits on acceleration are none on weight; 0: they carry nothing."""
    lookahead: int = 1
    """Waypoints ahead of the nearest one that the guidance aims at (0 is the paper's ablation without feed-forward)."""
    follow_object: bool = False
    """Guidance on the object's current pose instead of its pose at the start of the episode."""
    finger_guidance: float = 0.0
    """rad per control step by which finger targets close from the middle of the approach on, when the wrist has come;
    0 leaves them to the action (the paper's method)."""


@dataclasses.dataclass(frozen=True)
class SensingConfig:
    """The tracker that shows the object's pose (`common.task.sensing`): ranges, uniform at every reset.

    With zeros, the default, it shows the true pose with every control step.
    """

    period: tuple[float, float] = (0.0, 0.0)
    """Seconds between two samples: 0.033 at 30 Hz. Up to a control step: one with each."""
    delay: tuple[float, float] = (0.0, 0.0)
    """Seconds between a sample and its arrival, to the nearest control step; at most 1."""
    position_noise: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of each coordinate of a sample, m."""
    rotation_noise: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of a sample's turn about each axis, rad."""
    dropout: tuple[float, float] = (0.0, 0.0)
    """Probability that a sample never arrives."""
    position_bias: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of each coordinate of an error that all samples of an episode share, m."""
    rotation_bias: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of the turn about each axis that all samples of an episode share, rad."""
    settle: float = 0.0
    """The object's first pose, by which the wrist is guided, is the mean of all readings until one is this far from it,
    m, or the table goes; 0: the first reading."""


@dataclasses.dataclass(frozen=True)
class TaskConfig(_Shares):
    """The task: hand, timing, observation, control, reward and constraint sampling."""

    hand: str = "human"
    """Name of the hand, or a hand file (`congrasp hands list` and `import`)."""
    method: str = "ours"
    """Name of the method that its policy is of (`common.task.methods`): `congrasp train --method` makes its changes."""
    object_scale: float = 0.0
    """Factor on the objects' lengths; 0 takes the hand's own (1.4 for Allegro, 1.1 for Sharpa)."""
    constant_mass: bool = True
    """An object keeps its mass when its lengths are scaled; else its density."""
    control_dt: float = 0.01
    """Seconds between two actions."""
    substeps: int = 4
    """Physics steps in one control step."""
    approach_steps: int = 100
    """Control steps before the table is removed; 50 in the paper."""
    hold_steps: int = 25
    """Control steps without the table that count for success (and the least in training)."""
    hold_steps_max: int = 25
    """Training draws the hold's length between `hold_steps` and this, short ones more often."""
    end_when_fallen: bool = True
    """Holds longer than `hold_steps` end as soon as the object has fallen."""
    dynamic_center: bool = True
    """Hand centre from the live fingertips; false is the paper's ablation: from the fingertips at the episode's start,
    fixed in the wrist frame."""
    hand_table_collision: bool = True
    """Whether the hand collides with the table."""
    hand_self_collision: bool = True
    """Whether the hand's links collide with one another."""
    contact_time: float = CONTACT_TIME
    """Time constant of the hand's contacts, s; at least two physics steps. At 0.006 a grasp's are about 1 mm deep."""
    torsional_friction: float = 0.004
    """Metres, of contacts of fingertips with the object (condim 4): the sliding friction times about two thirds of the
    contact patch's radius; 0: point contacts. The engine `jax` knows point contacts alone."""
    object_damping: float = 5e-5
    """Damping of the free object, N.s/m and N.m.s/rad: what pivots between two fingers swings for about a second."""
    back_off: float = 0.15
    """Metres from the aligned wrist to its start, against the heading direction."""
    back_off_range: tuple[float, float] = (0.05, 0.25)
    """The same in training, uniform at every reset."""
    initial_speed: float = 0.8
    """Training begins with a wrist that moves along the heading with up to this speed, m/s, at the far end of
    `back_off_range`, and proportionally less nearer by; 0: at rest."""
    preshape: bool = True
    """Fingers begin opened to the object's width at the heading (`common.hands.closure`); else in the open pose."""
    preshape_margin: tuple[float, float] = (0.015, 0.06)
    """Metres that the fingers are opened wider than the object in training, uniform at every reset."""
    surface_points: int = 256
    """Surface points of an object that the policy senses (at most 512)."""
    trajectory_points: int = 15
    """K, waypoints of a wrist trajectory."""
    constraints: tuple[str, ...] = OURS
    """Constraints that the policy knows: what it observes, and can be asked for."""
    headings: Literal["all", "above", "center"] = "all"
    """`above` keeps approach directions within 30 degrees of straight down, where there are any (easier); `center`
    keeps headings at which the hand's centre alone is above the table (harder: a row of the exam)."""
    own_references: bool = True
    """Half of an object's reference poses and trajectories are remade from the policy's own grasps as it learns; the
    others, or all without, stay those that closing the hand around the objects gave."""
    p_together: float = 0.0
    """Probability that an episode with an affordance also gets a wrist trajectory that agrees with it, where the object
    has one; in addition to those that `p_trajectory` gives."""
    aligned_references: bool = False
    """An episode with a reference pose and a wrist trajectory gets the trajectory to that pose; otherwise the two are
    drawn independently, as in the paper, and the trajectory may end elsewhere."""
    disturbed_references: float = 0.0
    """Share of the episodes whose reference pose and wrist trajectory have errors as captured ones have
    (`common.task.sampling.disturbances`)."""
    mass_range: tuple[float, float] = (1.0, 1.0)
    """Factors of the object's mass, uniform at every reset."""
    friction_range: tuple[float, float] = (1.0, 1.0)
    """Sliding friction between the hand and the object, uniform at every reset."""
    gain_range: tuple[float, float] = (1.0, 1.0)
    """Factors of the finger servos' gains, uniform at every reset."""
    observation: Literal["full", "tracked"] = "full"
    """What the policy sees: all of the simulator, or what a robot has (`common.task.sensing`): joint angles and
    targets, the wrist, and the object's pose from a tracker; no forces and no velocities, but the last `history`
    steps."""
    history: int = 8
    """Control steps that a tracked observation shows, the present one among them: 2 to 64."""
    sensing: SensingConfig = SensingConfig()
    """The tracker. A policy that sees all gets the object's pose from it, too, where it is not perfect."""
    drop_height: float = 0.05
    """The object has fallen when it is this far (m) below its height at the table's removal."""
    control: ControlConfig = ControlConfig()
    """How actions become joint targets."""
    reward: RewardWeights = RewardWeights()
    """The reward's weights."""

    @property
    def sensed(self) -> bool:
        """Whether the policy sees anything else than the true state of the simulation."""
        return self.observation == "tracked" or self.sensing != SensingConfig()


Split = Literal["all", "training", "held-out"]
"""Parts of constraint sets."""


@dataclasses.dataclass(frozen=True)
class ObjectsConfig:
    """Which objects a run uses."""

    families: tuple[str, ...] = ()
    """Families of the procedural generator, or groups of them (basic, household, all); empty means basic."""
    count: int = 64
    """Procedural objects in one actor's pool."""
    seed: int = 0
    """First seed; actors shift it so that each has its own objects. Evaluation uses seeds from one million upward."""
    folder: str = ""
    """A folder of imported objects to use instead of procedural ones."""
    constraints: str = ""
    """A folder of constraint sets of that folder's objects, such as captured ones ('congrasp constraints import'):
    training draws headings, reference poses and trajectories from them. Objects without a set are left out."""
    split: Split = "training"
    """Of these sets the part for training, what is held out, or all."""
    procedural: int = 0
    """Procedural objects beside those of the folder."""
    folder_share: float = 0.0
    """Share of the episodes that have an object of the folder, where there are procedural ones beside; 0: every object
    is drawn alike."""
    renew_every: int = 0
    """Rollouts after which an actor's procedural objects are replaced by the next ones by their seeds, and its episodes
    start anew; 0 keeps them. Making them takes the time that the first ones took."""
    by_failure: bool = False
    """Objects that fall more often than others are drawn up to twice as often, and those that fall less often down to
    half as often, by the actor's own episodes (the folder's share shifts with them)."""

    def __post_init__(self) -> None:
        """Raises a CongraspError for constraint sets without their objects."""
        if self.constraints and not self.folder:
            raise CongraspError("Constraint sets need their objects.", "Name their folder: --objects.folder FOLDER.")


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the policy's and the critic's networks (they share no weights)."""

    hidden: tuple[int, ...] = (512, 256, 128)
    """Units of the trunk's layers."""
    encoder: int = 64
    """Units of each optional constraint's encoder."""
    initial_std: float = 0.6
    """Standard deviation of the action at the start, in units of action."""
    privileged_critic: bool = True
    """The critic also sees what the actor lacks: the episode's true parameters, such as the object's mass, and the true
    state where the policy has sensors (`common.task.privileged`)."""


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Decoupled PPO (Hilton et al. 2021, arXiv 2110.00641) with adaptive-KL learning rate.

    The batch (`rollouts_per_update`) and `max_staleness` hold for every algorithm.
    """

    rollouts_per_update: int = 2
    """Rollout messages that one update consumes (the batch)."""
    epochs: int = 4
    """Passes over the batch."""
    minibatches: int = 16
    """Minibatches in one pass."""
    clip: float = 0.2
    """Clip of pi/pi_proximal."""
    importance_max: float = 4.0
    """Truncation of pi_proximal/pi_behaviour."""
    decoupled: bool = True
    """Clip around the policy at the update's start; else around the one that acted, as plain PPO does."""
    gamma: float = 0.98
    """Discount."""
    gae_lambda: float = 0.95
    """Lambda of the generalised advantage estimate."""
    bootstrap_truncated: bool = True
    """Bootstraps from the critic where the time limit ends an episode whose object is up, instead of from zero."""
    learning_rate: float = 5e-4
    """Adam's rate at the start."""
    learning_rate_range: tuple[float, float] = (1e-5, 3e-3)
    """Bounds of the adaptive rate."""
    kl_target: float = 0.012
    """The rate falls above twice this and rises below half of it."""
    settling: float = 0.0
    """Share of the run's updates, its last ones, over which `kl_target` falls linearly to a tenth and the action's
    standard deviation to `final_std`, so that the policy settles; 0 keeps both."""
    final_std: float = 0.1
    """Standard deviation of the action at the end of `settling`, in units of action. With n updates left, it is capped
    at std (final_std / std)^(1/n): a geometric fall. Smaller deviations stay; 0 sets no cap."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    value_coefficient: float = 0.5
    """Weight of the value loss."""
    max_grad_norm: float = 1.0
    """Global norm at which gradients are clipped."""
    reward_scale: float = 0.1
    """Factor on rewards before returns are made."""
    max_staleness: int = 1
    """eta: versions by which an accepted rollout may be behind the update that uses it."""

    def kl_target_at(self, version: int, updates: int) -> float:
        """The KL target of the update of this version, in a run of so many updates."""
        return self.kl_target * (1.0 - 0.9 * min(max(self._settled(version, updates), 0.0), 1.0))

    def noise_kept_at(self, version: int, updates: int) -> float:
        """Share k of log(std / final_std) that the update of this version keeps at most; infinity before `settling`.

        With n updates left k = 1 - 1/n. After j of m updates std is at most std_0^(1 - j/m) final_std^(j/m).
        """
        if self.final_std <= 0.0 or not self.settling or self._settled(version, updates) < 0.0:
            return math.inf
        return 1.0 - 1.0 / max(updates - version, 1)

    def _settled(self, version: int, updates: int) -> float:
        """Share of `settling` before the update of this version; negative before it begins."""
        return 1.0 - (updates - version) / (self.settling * updates) if self.settling and updates else 0.0


@dataclasses.dataclass(frozen=True)
class DistillConfig:
    """Distillation of a policy into another one (`learner.algorithms.distill`)."""

    teacher: str = ""
    """The policy that teaches: its file, or the hand of a pretrained one."""
    epochs: int = 2
    """Passes over the batch."""
    minibatches: int = 16
    """Minibatches in one pass."""
    learning_rate: float = 1e-3
    """Adam's rate at the start; it falls linearly to a fiftieth over the run's updates."""
    max_grad_norm: float = 1.0
    """Global norm at which gradients are clipped."""


@dataclasses.dataclass(frozen=True)
class CurriculumConfig:
    """The paper's two phases: first stationary objects, then free ones with larger constraint weights."""

    stationary_updates: int = 0
    """Updates for which objects are held in place and the table stays."""
    ramp: tuple[int, int] = (0, 0)
    """Updates between which the weights go from those of the task to `reward`; none if the two are equal."""
    reward: RewardWeights = RewardWeights()
    """The reward's weights at the end of the ramp."""

    @property
    def ramped(self) -> bool:
        """Whether the weights change at all."""
        return self.ramp[0] < self.ramp[1]

    def stationary(self, version: int) -> bool:
        """Whether objects are held in place under the policy of this version."""
        return version < self.stationary_updates

    def weights(self, first: RewardWeights, version: int) -> RewardWeights:
        """The reward's weights under the policy of this version; `first` are those of the task."""
        if not self.ramped:
            return first
        begin, end = self.ramp
        share = min(max((version - begin) / (end - begin), 0.0), 1.0)
        return RewardWeights(
            **{
                field.name: (1 - share) * getattr(first, field.name) + share * getattr(self.reward, field.name)
                for field in dataclasses.fields(RewardWeights)
            }
        )


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """One training run."""

    name: str = "run"
    """Name of the run; it is part of every key on the wire."""
    seed: int = 0
    """Seed of networks, minibatches and environments."""
    environments: int = 64
    """Environments in one actor."""
    rollout_steps: int = 75
    """Control steps in one rollout message."""
    updates: int = 1000
    """Updates after which the run ends."""
    physics: PhysicsName = "auto"
    """Physics engine of the actors."""
    half_observations: bool = True
    """Observations travel (and are acted on) as float16."""
    checkpoint_every: int = 25
    """Updates between two checkpoints."""
    write_ahead: bool = True
    """Rollouts are on disk before they are acknowledged, until a checkpoint holds their outcome: a resume takes them up
    whatever was killed. Without, a killed learner takes along what it had accepted since the checkpoint."""
    collapse_patience: int = 60
    """Updates in a row without contact, or with less than half of the best success, that end the run; 0: none do."""
    episode_every: int = 10
    """Rollouts of an actor between two episodes that it publishes for logs; at least so many, for only an episode that
    ends in its rollout alone is published."""
    log_rollout_every: int = 20
    """Rollouts of an actor between two that it publishes for logs; 1 publishes all of them, 0 none."""
    log_rollout_worlds: int = 4
    """Environments of a rollout that are published for logs; 0 publishes all of them."""
    task: TaskConfig = TaskConfig()
    """The task."""
    curriculum: CurriculumConfig = CurriculumConfig()
    """How the task changes while it is learnt."""
    objects: ObjectsConfig = ObjectsConfig()
    """The objects."""
    network: NetworkConfig = NetworkConfig()
    """The networks."""
    algorithm: str = "ppo"
    """Name of the learner's algorithm."""
    ppo: PPOConfig = PPOConfig()
    """The algorithm's hyperparameters."""
    distill: DistillConfig = DistillConfig()
    """Those of distillation."""


def to_json(config: Any) -> str:
    """A configuration dataclass as JSON text."""
    return json.dumps(dataclasses.asdict(config), indent=2, sort_keys=True)


def run_config_from_json(text: str | bytes) -> RunConfig:
    """The inverse of `to_json` for a `RunConfig`; unknown keys and wrong types are errors that name the key."""
    try:
        fields = json.loads(text, parse_constant=_no_constant)
        if not isinstance(fields, dict):
            raise ValueError("it is no object")
        if "task" in fields:
            fields["task"] = with_older_physics(fields["task"])
        if isinstance(fields.get("network"), dict):
            fields["network"] = with_older_critic(fields["network"])
        config = dacite.from_dict(RunConfig, fields, dacite.Config(strict=True, cast=[tuple, float]))
    except (ValueError, RecursionError) as error:  # no UTF-8, or nested too deep
        raise CongraspError(
            f"The configuration is not JSON: {error}.", "Regenerate it with 'congrasp train'."
        ) from None
    except (dacite.DaciteError, TypeError, OverflowError) as error:  # such as null for a number
        raise CongraspError(f"The configuration does not fit this version: {error}.") from None
    file_name(config.name, "a run")
    return config


def with_older_physics(task: Any) -> Any:
    """A `TaskConfig` from JSON; physics and constraints that an older file does not name are those of then.

    Args:
      task: the value, of whatever type; only an object of which `control` is one, too, or is not there, is changed.
    """
    control = task.get("control", {}) if isinstance(task, dict) else None
    if not isinstance(control, dict):
        return task
    fastest = control.get("guidance_position_limit", 0.04)
    then = {
        "wrist_acceleration": 0.0,
        "wrist_angular_acceleration": 0.0,
        "hold_acceleration": 1.0,
        "load_rate": 0.0,
        "approach_position_limit": fastest,
        "closing_position_limit": fastest,
    }
    back_off = task.get("back_off", 0.15)
    begun = {
        "constraints": PAPER,
        "constant_mass": False,
        "torsional_friction": 0.0,
        "object_damping": 5e-4,
        "preshape": False,
        "initial_speed": 0.0,
        "back_off_range": [back_off, back_off],
    }
    return {"contact_time": 0.016, **begun, **task, "control": {**then, **control}}


def with_older_critic(network: dict[str, Any]) -> dict[str, Any]:
    """A `NetworkConfig` from JSON; the critic of an older file sees the observation alone."""
    return {"privileged_critic": False, **network}


def _no_constant(name: str) -> float:
    raise ValueError(f"it holds {name}")


def digest(config: Any) -> str:
    """Sixteen hex digits that identify a configuration's content."""
    return hashlib.sha256(to_json(config).encode()).hexdigest()[:16]
