"""Variations of an experiment: rows of its tables that change masses, sensors, references or
headings.
"""

import dataclasses
import math
import zlib
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.actors.initial import InitialConditions
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.motors import follow_couplings
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.services.evaluate.episodes import identity
from congrasp.services.evaluate.experiment import Experiment, Variation
from congrasp.services.evaluate.paper.figures import CENTER_GROUP

MASSES = (0.05, 0.1, 0.25, 0.5, 1.0, 1.5, 2.0)
"""Masses of the table `payload`, kg."""


@dataclasses.dataclass(frozen=True)
class Center(Variation):
    """Headings that only keep the hand's centre above the table."""

    label: str = CENTER_GROUP

    def bank(self, experiment: Experiment) -> ConstraintBank:
        """See `Variation.bank`."""
        return experiment.by_center


@dataclasses.dataclass(frozen=True)
class Noise(Variation):
    """References with errors like captured ones; errors of the row are relative to the request,
    including noise.

    * joints: an independent normal error of standard deviation `level` on every finger joint,
      clipped to its limits.
    * depth: a displacement of the wrist along the hand's heading axis, into the object, uniform up
      to `level`.
    * jitter: an independent normal error of standard deviation `level` on every coordinate of every
      waypoint.
    """

    kind: str = ""
    """joints, depth or jitter; empty for no noise."""
    level: float = 0.0
    """rad for joints, m otherwise."""

    def bank(self, experiment: Experiment) -> ConstraintBank:
        """See `Variation.bank`."""
        bank = experiment.bank_for(self.constraint)
        rng = np.random.default_rng(experiment.seed)
        if self.kind == "joints":
            hand = experiment.hand
            q = np.asarray(bank.pose_q)
            noisy = np.clip(q + rng.normal(0.0, self.level, q.shape), hand.lower, hand.upper)
            return bank._replace(pose_q=follow_couplings(hand, noisy).astype(np.float32))
        if self.kind == "depth":
            position = np.asarray(bank.pose_position)
            quaternion = np.asarray(bank.pose_quaternion).reshape(-1, 4)
            turn = Rotation.from_quat(quaternion, scalar_first=True)
            inward = turn.apply(grasp_frame(experiment.hand).heading).reshape(position.shape)
            depth = rng.uniform(0.0, self.level, (*position.shape[:-1], 1))
            return bank._replace(pose_position=(position + depth * inward).astype(np.float32))
        if self.kind == "jitter":
            path = np.asarray(bank.trajectory_position)
            noisy = path + rng.normal(0.0, self.level, path.shape)
            return bank._replace(trajectory_position=noisy.astype(np.float32))
        return bank


@dataclasses.dataclass(frozen=True)
class Sensors(Variation):
    """A tracker, a friction and an error of the gains; by default a tracker with 30 Hz, 5 mm, 3
    degrees and 60 ms.

    A policy of the full state gets the tracker's pose instead of the true one, and keeps its
    contact forces and velocities. Errors and losses use the same random numbers at all levels.
    """

    position_noise: float = 0.005
    """Standard deviation of each coordinate, m."""
    rotation_noise: float = math.radians(3.0)
    """Standard deviation about each axis, rad."""
    delay: float = 0.06
    """s."""
    rate: float = 30.0
    """Hz."""
    dropout: float = 0.0
    """Share of lost samples."""
    friction: float | None = None
    """Sliding friction between hand and object; None: that of the evaluation."""
    gains: float = 1.0
    """Factor on the finger servos' gains."""
    latency: float = 0.0
    """Seconds until the servos follow a target."""

    def task(self, task: TaskConfig) -> TaskConfig:
        """Returns the task in which a policy observes trackers, with room for the longest delay of
        `SENSING`.
        """
        longest_delay = max(level.delay for level in SENSING)
        longest_latency = max(level.latency for level in SENSING)
        sensing = SensingConfig(
            delay=(0.0, longest_delay),
            latency=(0.0, longest_latency),
            settle=task.sensing.settle,
        )
        return dataclasses.replace(task, sensing=sensing)

    def episodes(self, conditions: InitialConditions, control_dt: float) -> InitialConditions:
        """See `Variation.episodes`."""
        values = {
            "period": max(1.0 / (self.rate * control_dt), 1.0),
            "delay": round(self.delay / control_dt),
            "position_noise": self.position_noise,
            "rotation_noise": self.rotation_noise,
            "dropout": self.dropout,
            "latency": round(self.latency / control_dt),
        }
        sensors = conditions.sensors
        of_all_worlds = {
            name: jnp.full_like(getattr(sensors, name), value) for name, value in values.items()
        }
        start = conditions.reset_state
        start = start._replace(gain_scale=jnp.full_like(start.gain_scale, self.gains))
        if self.friction is not None:
            start = start._replace(friction=jnp.full_like(start.friction, self.friction))
        return conditions._replace(sensors=sensors._replace(**of_all_worlds), reset_state=start)


@dataclasses.dataclass(frozen=True)
class Load(Variation):
    """Mass of an object and friction of an episode, each uniform in a range; by default those of
    the evaluation.

    The inertia is scaled with the mass. Objects are replaced instead of scaling the mass of an
    episode: engines derive the softness of contacts from the mass at compilation, and diverge far
    from it.
    """

    mass: tuple[float, float] | None = None
    """kg; the object's name determines the position in the range."""
    friction: tuple[float, float] | None = None
    """Sliding friction between hand and object; the episode determines the position in the
    range.
    """
    factor: float = 1.0
    """Factor on the object's mass, if no mass is given."""

    def objects(self, objects: Sequence[GraspObject]) -> list[GraspObject]:
        """See `Variation.objects`."""
        loaded = []
        for obj in objects:
            mass = self.factor * obj.mass
            if self.mass is not None:
                low, high = self.mass
                mass = low + (high - low) * zlib.crc32(obj.name.encode()) / 2**32
            inertia = obj.inertia * mass / obj.mass
            loaded.append(dataclasses.replace(obj, mass=mass, inertia=inertia))
        return loaded

    def episodes(self, conditions: InitialConditions, control_dt: float) -> InitialConditions:
        """See `Variation.episodes`."""
        if self.friction is None:
            return conditions
        low, high = self.friction
        hashes = [zlib.crc32(episode.tobytes()) for episode in identity(conditions)]
        share = np.array(hashes) / 2**32
        friction = (low + (high - low) * share).astype(np.float32)
        return conditions._replace(reset_state=conditions.reset_state._replace(friction=friction))


NOISE = (
    Noise("pose"),
    Noise("pose", "joints 0.1 rad", "joints", 0.1),
    Noise("pose", "joints 0.2 rad", "joints", 0.2),
    Noise("pose", "depth 0.5 cm", "depth", 0.005),
    Noise("pose", "depth 1 cm", "depth", 0.01),
    Noise("trajectory"),
    Noise("trajectory", "jitter 0.5 cm", "jitter", 0.005),
    Noise("trajectory", "jitter 1 cm", "jitter", 0.01),
)
"""Rows of the table `noise` (paper, noisy constraints)."""
SENSING = (
    Sensors(
        label="the true pose", position_noise=0.0, rotation_noise=0.0, delay=0.0, rate=math.inf
    ),
    Sensors(label="5 mm 3°, 30 Hz, 60 ms"),
    Sensors(label="no noise", position_noise=0.0, rotation_noise=0.0),
    Sensors(label="10 mm 6°", position_noise=0.01, rotation_noise=math.radians(6.0)),
    Sensors(label="no delay", delay=0.0),
    Sensors(label="100 ms", delay=0.1),
    Sensors(label="10 Hz", rate=10.0),
    Sensors(label="10 % dropped", dropout=0.1),
    Sensors(label="30 % dropped", dropout=0.3),
    Sensors(label="friction 0.5", friction=0.5),
    Sensors(label="gains -20 %", gains=0.8),
    Sensors(label="gains +20 %", gains=1.2),
    Sensors(label="targets 20 ms late", latency=0.02),
    Sensors(label="targets 40 ms late", latency=0.04),
)
"""Rows of the table `sensing`; each but the first differs from the second, a typical tracker, in
one setting.
"""
PEERS = (
    Load(label="RobustDexGrasp: 0.25 kg, friction 0.8", mass=(0.25, 0.25), friction=(0.8, 0.8)),
    Load(label="dexsuite: 0.04-0.5 kg, friction 0.5-1", mass=(0.04, 0.5), friction=(0.5, 1.0)),
)
"""Rows of the table `peers`: conditions of RobustDexGrasp (arXiv:2504.05287) and of Isaac Lab's
dexsuite.
"""


def payload(scale: float, *, constant_mass: bool) -> tuple[Load, ...]:
    """Rows of the table `payload`: fixed masses, the objects' masses, and masses scaled with
    lengths if different.

    Args:
      scale: factor on the lengths of the hand's objects.
      constant_mass: setting of the task; True if the evaluated objects keep their mass when scaled.
    """
    # Inverse of the factor by which the scaling changed the masses of the objects.
    unscaled = 1.0 if constant_mass else scale**-3
    rows = [Load(label=f"{mass:g} kg", mass=(mass, mass)) for mass in MASSES]
    rows.append(Load(label="masses of the objects", factor=unscaled))
    if scale != 1.0:
        label = f"masses scaled with the lengths x {scale:g}"
        rows.append(Load(label=label, factor=unscaled * scale**3))
    return tuple(rows)
