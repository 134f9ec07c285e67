"""All settings of a run as frozen dataclasses; the string under a field is its help on the command line.

A run is described by one `RunConfig`. It is sent as JSON: the learner stores it in the run directory and sends it to
every actor that connects. An actor therefore needs no argument but an address.
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
from congrasp.common.task.constraints import CONSTRAINTS, OURS
from congrasp.common.task.reward import GRASP

MetricWriter = Literal["tensorboard", "wandb", "wandb-offline"]
"""Additional metric writers of a learner, alongside the recordings."""


def _declared(fields: Iterable[tuple[str, float, str]]) -> Any:
    """Returns a frozen dataclass of numbers declared elsewhere, from (name, default, help) triples."""
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
    """Weights of all reward terms, of the grasp and of each constraint, in units of reward per control step."""


@dataclasses.dataclass(frozen=True)
class ControlConfig:
    """Mapping from actions to joint targets (paper, section Control Space)."""

    finger_scale: float = 0.1
    """alpha_f, rad per unit of action and control step."""
    wrist_position_scale: float = 0.02
    """alpha_w of the three slides, m per unit of action."""
    wrist_rotation_scale: float = 0.1
    """alpha_w of the three hinges, rad per unit of action."""
    guidance_position_limit: float = 0.04
    """Largest distance of the wrist's target from the wrist, m: at kp/kv = 20/s a speed of 0.8 m/s."""
    approach_position_limit: float = 0.02
    """The same while the table is present: 0.4 m/s, no faster than the end of a reach."""
    closing_position_limit: float = 0.015
    """The same within `closing_distance` of the object, while the table is present: 0.3 m/s."""
    closing_distance: float = 0.04
    """Distance between the hand's keypoints and the object, m, below which the hand approaches slowly."""
    guidance_rotation_limit: float = 0.3
    """Largest rotation of the wrist's target from the wrist, rad: 5 rad/s."""
    wrist_acceleration: float = 15.0
    """Greatest linear acceleration by the wrist's servos, m/s^2; with its inertia this also limits their force. 0: no
    limit."""
    wrist_angular_acceleration: float = 150.0
    """Greatest angular acceleration by the wrist's servos, rad/s^2. 0: no limit."""
    hold_acceleration: float = 1 / 3
    """Share of both limits after the table is removed, except for braking; it reduces the wrist's tremor."""
    load_rate: float = 60.0
    """Inverse time constant (1/s) of the observer of the wrist's load. Its estimate is added to the wrist's targets
    after the table is removed, so that the limits on acceleration do not limit weight. 0: no compensation."""
    lookahead: int = 1
    """Waypoints between the nearest one and the guidance (0 is the paper's ablation without feed-forward)."""
    follow_object: bool = False
    """Guides relative to the object's current pose instead of its pose at the start of the episode."""
    finger_guidance: float = 0.0
    """rad per control step by which finger targets close from the middle of the approach on, once the wrist has
    arrived; 0 leaves the fingers to the action (the paper's method)."""


@dataclasses.dataclass(frozen=True)
class SensingConfig:
    """Tracker that measures the object's pose (`common.task.sensing`): ranges, drawn uniformly at every reset.

    With zeros, the default, it gives the true pose at every control step.
    """

    period: tuple[float, float] = (0.0, 0.0)
    """Seconds between two samples: 0.033 at 30 Hz. Values up to a control step give one sample a step."""
    delay: tuple[float, float] = (0.0, 0.0)
    """Latency of a sample in seconds, rounded to control steps; at most 1."""
    position_noise: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of each coordinate of a sample, m."""
    rotation_noise: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of a sample's rotation about each axis, rad."""
    dropout: tuple[float, float] = (0.0, 0.0)
    """Probability that a sample is lost."""


@dataclasses.dataclass(frozen=True)
class TaskConfig(_Shares):
    """The task: hand, timing, observation, control, reward and constraint sampling."""

    hand: str = "human"
    """Name of the hand, or a hand file (`congrasp hands list` and `import`)."""
    method: str = "ours"
    """Name of the policy's method (`common.task.methods`): `congrasp train --method` applies its settings."""
    object_scale: float = 0.0
    """Factor on the objects' lengths; 0 uses the hand's default (1.4 for Allegro, 1.1 for Sharpa)."""
    constant_mass: bool = True
    """Keeps an object's mass when its lengths are scaled; otherwise its density is kept."""
    control_dt: float = 0.01
    """Seconds between two actions."""
    substeps: int = 4
    """Physics steps in one control step."""
    approach_steps: int = 100
    """Control steps before the table is removed; 50 in the paper."""
    hold_steps: int = 25
    """Control steps without the table that count for success (and the minimum in training)."""
    hold_steps_max: int = 25
    """Training draws the length of the hold between `hold_steps` and this, short ones more often."""
    end_when_fallen: bool = True
    """Ends holds longer than `hold_steps` as soon as the object has fallen."""
    dynamic_center: bool = True
    """Computes the hand centre from the current fingertips; false is the paper's ablation: from the fingertips at the
    start of the episode, fixed in the wrist frame."""
    hand_table_collision: bool = True
    """Enables collisions between the hand and the table."""
    hand_self_collision: bool = True
    """Enables collisions between the hand's links."""
    contact_time: float = CONTACT_TIME
    """Time constant of the hand's contacts, s; at least two physics steps. At 0.006 a grasp's contacts are about 1 mm
    deep."""
    torsional_friction: float = 0.004
    """Torsional friction of contacts of fingertips with the object (condim 4), m: the sliding friction times about two
    thirds of the contact patch's radius. 0: point contacts. The engine `jax` supports point contacts only."""
    object_damping: float = 5e-5
    """Damping of the free object, N.s/m and N.m.s/rad: an object that pivots between two fingers swings for about a
    second."""
    back_off: float = 0.15
    """Distance from the aligned wrist to its start, against the heading direction, m."""
    back_off_range: tuple[float, float] = (0.05, 0.25)
    """The same in training, drawn uniformly at every reset."""
    initial_speed: float = 0.8
    """Largest initial speed of the wrist along the heading in training, m/s. It is reached at the far end of
    `back_off_range` and is proportionally lower nearer by. 0: at rest."""
    preshape: bool = True
    """Opens the fingers to the object's width at the heading (`common.hands.closure`) at the start; otherwise they
    begin in the open pose."""
    preshape_margin: tuple[float, float] = (0.015, 0.06)
    """Distance by which the fingers are opened wider than the object in training, m, drawn uniformly at every reset."""
    surface_points: int = 256
    """Surface points of an object that the policy observes (at most 512)."""
    trajectory_points: int = 15
    """K, waypoints of a wrist trajectory."""
    constraints: tuple[str, ...] = OURS
    """Constraints that the policy supports: it observes them, and requests may contain them."""
    headings: Literal["all", "above", "center"] = "all"
    """`above` keeps approach directions within 30 degrees of straight down, where there are any (easier); `center`
    takes the paper's rules only, with the hand's centre above the table (harder: a row of the evaluation)."""
    own_references: bool = True
    """Regenerates half of an object's reference poses and trajectories from the policy's current grasps during
    training. The others, or all of them if false, come from closing the hand around the objects."""
    p_together: float = 0.0
    """Probability that an episode with an affordance also gets a wrist trajectory that agrees with it, where the object
    has one. These are in addition to those of `p_trajectory`."""
    aligned_references: bool = False
    """Gives an episode with a reference pose and a wrist trajectory the trajectory to that pose. Otherwise the two are
    drawn independently, as in the paper, and the trajectory may end elsewhere."""
    disturbed_references: float = 0.0
    """Share of the episodes whose reference pose and wrist trajectory are disturbed like captured ones
    (`common.task.sampling.disturbances`)."""
    mass_range: tuple[float, float] = (1.0, 1.0)
    """Factors on the object's mass, drawn uniformly at every reset."""
    friction_range: tuple[float, float] = (1.0, 1.0)
    """Sliding friction between hand and object, drawn uniformly at every reset."""
    gain_range: tuple[float, float] = (1.0, 1.0)
    """Factors on the finger servos' gains, drawn uniformly at every reset."""
    observation: Literal["full", "tracked"] = "full"
    """Observation of the policy: the full state of the simulator, or the sensors of a robot (`common.task.sensing`):
    joint angles and targets, the wrist, and the object's pose from a tracker; no forces and no velocities, but the last
    `history` steps."""
    history: int = 8
    """Control steps in a tracked observation, including the current one: 2 to 64."""
    sensing: SensingConfig = SensingConfig()
    """The tracker. A policy that observes the full state also gets the object's pose from it, unless it is perfect."""
    drop_height: float = 0.05
    """Distance below the object's height at the table's removal at which it counts as fallen, m."""
    control: ControlConfig = ControlConfig()
    """Mapping from actions to joint targets."""
    reward: RewardWeights = RewardWeights()
    """Weights of the reward terms."""

    @property
    def sensed(self) -> bool:
        """True if the policy observes anything but the true state of the simulation."""
        return self.observation == "tracked" or self.sensing != SensingConfig()


Split = Literal["all", "training", "held-out"]
"""Split of the constraint sets."""


@dataclasses.dataclass(frozen=True)
class ObjectsConfig:
    """Objects of a run."""

    families: tuple[str, ...] = ()
    """Families of the procedural generator, or groups of them (basic, household, all); empty: basic."""
    count: int = 64
    """Procedural objects in one actor's pool."""
    seed: int = 0
    """First seed; actors shift it so that each has different objects. Evaluation uses seeds from one million upward."""
    folder: str = ""
    """A folder of imported objects to use instead of procedural ones."""
    constraints: str = ""
    """A folder of constraint sets for that folder's objects, such as captured ones ('congrasp constraints import'):
    training draws headings, reference poses and trajectories from them. Objects without a set are left out."""
    split: Split = "training"
    """Split of these sets: training, held-out, or all."""
    procedural: int = 0
    """Procedural objects in addition to those of the folder."""
    folder_share: float = 0.0
    """Share of the episodes with an object of the folder, if there are procedural ones as well; 0: all objects are
    equally likely."""
    renew_every: int = 0
    """Rollouts after which an actor's procedural objects are replaced by those of the next seeds and its episodes
    restart; 0 keeps them. Generating them takes as long as at the start."""
    by_failure: bool = False
    """Draws objects that fall more often than others up to twice as often, and those that fall less often down to half
    as often, by the actor's episodes (the folder's share shifts with them)."""

    def __post_init__(self) -> None:
        """Raises a CongraspError for constraint sets without objects."""
        if self.constraints and not self.folder:
            raise CongraspError("Constraint sets need their objects.", "Pass --objects.folder FOLDER.")


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the networks of the policy and the critic (they share no weights)."""

    hidden: tuple[int, ...] = (512, 256, 128)
    """Units of the trunk's layers."""
    encoder: int = 64
    """Units of each optional constraint's encoder."""
    initial_std: float = 0.6
    """Initial standard deviation of the action, in units of action."""
    privileged_critic: bool = True
    """Gives the critic what the policy does not observe: the episode's true parameters, such as the object's mass, and
    the true state if the policy has sensors (`common.task.privileged`)."""


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Decoupled PPO (Hilton et al. 2021, arXiv 2110.00641) with adaptive-KL learning rate.

    `rollouts_per_update` and `max_staleness` apply to every algorithm.
    """

    rollouts_per_update: int = 2
    """Rollouts consumed by one update (the batch)."""
    epochs: int = 4
    """Passes over the batch."""
    minibatches: int = 16
    """Minibatches in one pass."""
    clip: float = 0.2
    """Clip of pi/pi_proximal."""
    importance_max: float = 4.0
    """Truncation of pi_proximal/pi_behaviour."""
    decoupled: bool = True
    """Clips around the policy at the start of the update; otherwise around the behaviour policy, as plain PPO does."""
    gamma: float = 0.98
    """Discount."""
    gae_lambda: float = 0.95
    """Lambda of the generalised advantage estimate."""
    bootstrap_truncated: bool = True
    """Bootstraps from the critic if the time limit ends an episode with a held object; otherwise from zero."""
    learning_rate: float = 5e-4
    """Initial learning rate of Adam."""
    learning_rate_range: tuple[float, float] = (1e-5, 3e-3)
    """Bounds of the adaptive learning rate."""
    kl_target: float = 0.012
    """Target of the KL divergence: the learning rate falls above twice this value and rises below half of it."""
    settling: float = 0.0
    """Share of the run's updates, at its end, over which `kl_target` falls linearly to a tenth and the action's
    standard deviation to `final_std`, so that the policy converges; 0 keeps both."""
    final_std: float = 0.1
    """Standard deviation of the action at the end of `settling`, in units of action. With n updates left, it is capped
    at std (final_std / std)^(1/n): a geometric decay. Smaller deviations are kept; 0 sets no cap."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    value_coefficient: float = 0.5
    """Weight of the value loss."""
    max_grad_norm: float = 1.0
    """Global norm at which gradients are clipped."""
    reward_scale: float = 0.1
    """Factor on rewards before returns are computed."""
    max_staleness: int = 1
    """eta: greatest number of versions between an accepted rollout and the update that uses it."""

    def kl_target_at(self, version: int, updates: int) -> float:
        """Returns the KL target of the update of this version, in a run of `updates` updates."""
        return self.kl_target * (1.0 - 0.9 * min(max(self._settled(version, updates), 0.0), 1.0))

    def noise_kept_at(self, version: int, updates: int) -> float:
        """Largest share k of log(std / final_std) that the update of this version keeps; infinity before `settling`.

        With n updates left k = 1 - 1/n. After j of m updates std is at most std_0^(1 - j/m) final_std^(j/m).
        """
        if self.final_std <= 0.0 or not self.settling or self._settled(version, updates) < 0.0:
            return math.inf
        return 1.0 - 1.0 / max(updates - version, 1)

    def _settled(self, version: int, updates: int) -> float:
        """Share of `settling` completed before the update of this version; negative before it begins."""
        return 1.0 - (updates - version) / (self.settling * updates) if self.settling and updates else 0.0


@dataclasses.dataclass(frozen=True)
class DistillConfig:
    """Distillation of a policy into another (`learner.algorithms.distill`)."""

    teacher: str = ""
    """The teacher policy: its file, or the hand of a pretrained one."""
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
    """The paper's two phases: stationary objects first, then free ones with larger constraint weights."""

    stationary_updates: int = 0
    """Updates during which objects are fixed and the table stays."""
    ramp: tuple[int, int] = (0, 0)
    """First and last update of the ramp from the task's weights to `reward`; no ramp if they are equal."""
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
        """Returns the reward weights under the policy of this version; `first` are those of the task."""
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
    """Environments of one actor."""
    rollout_steps: int = 75
    """Control steps in one rollout message."""
    updates: int = 1000
    """Updates after which the run ends."""
    physics: PhysicsName = "auto"
    """Physics engine of the actors."""
    half_observations: bool = True
    """Sends observations (and acts on them) as float16."""
    checkpoint_every: int = 25
    """Updates between two checkpoints."""
    write_ahead: bool = True
    """Writes rollouts to disk before acknowledging them, until a checkpoint holds their outcome: a resumed run
    continues with them whatever was killed. If false, a killed learner loses what it had accepted since the
    checkpoint."""
    collapse_patience: int = 60
    """Consecutive updates without contact, or with less than half of the best success, that end the run; 0: never."""
    episode_every: int = 10
    """Rollouts of an actor between two episodes published for logs. It is a minimum, since only an episode that ends
    within its rollout is published."""
    log_rollout_every: int = 20
    """Rollouts of an actor between two published for logs; 1 publishes all of them, 0 none."""
    log_rollout_worlds: int = 4
    """Environments of a rollout published for logs; 0 publishes all of them."""
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


def to_json(config: Any) -> str:
    """Returns a configuration dataclass as JSON text."""
    return json.dumps(dataclasses.asdict(config), indent=2, sort_keys=True)


def run_config_from_json(text: str | bytes) -> RunConfig:
    """Parses the JSON text of a `RunConfig`; errors name unknown keys and wrong types."""
    try:
        fields = json.loads(text, parse_constant=_no_constant)
        if not isinstance(fields, dict):
            raise ValueError("it is not an object")
        config = dacite.from_dict(RunConfig, fields, dacite.Config(strict=True, cast=[tuple, float]))
    except (ValueError, RecursionError) as error:  # not UTF-8, or nested too deep
        raise CongraspError(
            f"The configuration is not JSON: {error}.", "Regenerate it with 'congrasp train'."
        ) from None
    except (dacite.DaciteError, TypeError, OverflowError) as error:  # such as null for a number
        raise CongraspError(f"The configuration does not match this version: {error}.") from None
    file_name(config.name, "a run")
    return config


def _no_constant(name: str) -> float:
    raise ValueError(f"it holds {name}")


def digest(config: Any) -> str:
    """Sixteen hex digits that identify a configuration's content."""
    return hashlib.sha256(to_json(config).encode()).hexdigest()[:16]
