"""Written settings of the task: control, sensing, timing and sampling. Constraints read these.

The string under a field is its help on the command line.
"""

import dataclasses
from typing import Literal, Self

from congrasp.common.hands.spec import CONTACT_TIME_S
from congrasp.common.task.sensor_registry import SensorName

GRAVITY = 9.81
"""m/s^2."""


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
    """Largest distance of the wrist's target from the wrist, m. It limits the speed to 0.8 m/s, at
    kp/kv = 20/s.
    """
    approach_position_limit: float = 0.02
    """Largest distance of the wrist's target from the wrist while the table is present, m. It
    limits the speed to 0.4 m/s, the speed at the end of a reach."""
    closing_position_limit: float = 0.015
    """Largest distance of the wrist's target from the wrist within `closing_distance` of the
    object, while the table is present, m. It limits the speed to 0.3 m/s."""
    closing_distance: float = 0.04
    """Distance between the hand's keypoints and the object, m, below which the hand approaches
    slowly.
    """
    guidance_rotation_limit: float = 0.3
    """Largest rotation of the wrist's target from the wrist, rad. It limits the speed to 5
    rad/s."""
    wrist_acceleration: float = 15.0
    """Largest linear acceleration by the wrist's servos, m/s^2. With the inertia of the hand it
    also limits their force. 0: no limit."""
    wrist_angular_acceleration: float = 150.0
    """Largest angular acceleration by the wrist's servos, rad/s^2. 0: no limit."""
    hold_acceleration: float = 1 / 3
    """Factor on both limits of acceleration after the table is removed, except for braking. It
    reduces the wrist's tremor.
    """
    load_rate: float = 60.0
    """Inverse time constant (1/s) of the observer that estimates the load on the wrist. After the
    table is removed, the wrist's targets compensate the estimated load, so that the limits of
    acceleration do not limit the weight that the hand can hold. 0: no compensation."""
    lookahead: int = 1
    """Number of waypoints by which the guidance is ahead of the waypoint nearest to the wrist (0 is
    the paper's ablation without feed-forward).
    """
    follow_object: bool = False
    """Guides the wrist relative to the object's current pose instead of its pose at the start of
    the episode.
    """
    finger_guidance: float = 0.0
    """Angle by which the finger targets close in each control step of the second half of the
    approach, rad. 0 leaves the fingers to the action (the paper's method)."""


@dataclasses.dataclass(frozen=True)
class SensingConfig:
    """Ranges of the properties of an object tracker (`common.task.sensors.tracker`) or of a camera
    that observes the object's surface (`common.task.sensors.camera`).

    Each episode samples them uniformly. With zeros, the default, the sensor has no errors and
    measures at every control step.
    """

    period: tuple[float, float] = (0.0, 0.0)
    """Seconds between two samples, such as 0.033 at 30 Hz. Values up to the length of a control
    step give one sample per step.
    """
    delay: tuple[float, float] = (0.0, 0.0)
    """Latency of a sample in seconds, rounded to control steps; at most 1."""
    position_noise: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of each coordinate of a sample, or of the depth of an image's point, m."""
    rotation_noise: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of a sample's rotation about each axis, rad."""
    dropout: tuple[float, float] = (0.0, 0.0)
    """Probability that a sample, or a point of an image, is lost."""
    position_bias: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of each coordinate of the position error that is constant in an episode,
    m."""
    rotation_bias: tuple[float, float] = (0.0, 0.0)
    """Standard deviation, about each axis, of the rotation error that is constant in an episode,
    rad.
    """
    settle: float = 0.0
    """Distance in m of a measured pose from the mean of those before, above which the mean is no
    longer updated. The guidance of the wrist uses this mean, which also stays constant once the
    table is removed. 0: the guidance uses the first pose."""
    single_image: float = 0.0
    """Share of the episodes in which the camera takes a single image, before the reach.
    """
    camera_distance: tuple[float, float] = (0.4, 0.8)
    """Distance of the camera from the object at the start, m."""
    camera_elevation: tuple[float, float] = (0.3, 1.2)
    """Elevation of the camera above the object, rad; at most 1.5."""
    camera_azimuth: tuple[float, float] = (-3.15, 3.15)
    """Azimuth of the direction from the object to the camera, from the world's x axis, rad."""
    latency: tuple[float, float] = (0.0, 0.0)
    """Seconds until the servos follow a target, rounded to control steps. The number of steps must
    be below `history`.
    """


@dataclasses.dataclass(frozen=True)
class TaskSettings:
    """The task, apart from what is derived from constraints and reward terms
    (`common.task.config.TaskConfig`).
    """

    hand: str = "human"
    """Name of the hand, or a hand file (`congrasp hands list` and `import`)."""
    method: str = "ours"
    """Name of the policy's method (`common.task.methods`): `congrasp train --method` applies its
    settings.
    """
    object_scale: float = 0.0
    """Factor on the objects' lengths; 0 uses the hand's default (1.4 for Allegro, 1.1 for
    Sharpa).
    """
    constant_mass: bool = True
    """Keeps an object's mass when its lengths are scaled; if false, keeps its density."""
    control_dt: float = 0.01
    """Seconds between two actions."""
    substeps: int = 4
    """Physics steps in one control step."""
    approach_steps: int = 100
    """Number of control steps before the table is removed; 50 in the paper."""
    hold_steps: int = 25
    """Number of control steps without the table after which a held object is a success. It is also
    the shortest hold in training."""
    hold_steps_max: int = 25
    """Longest hold in training, in control steps. Training samples the length of a hold between
    `hold_steps` and this number, short holds more often.
    """
    end_when_fallen: bool = True
    """Ends holds longer than `hold_steps` as soon as the object has fallen."""
    dynamic_center: bool = True
    """Computes the hand's centre from the current fingertips. If false (the paper's ablation), the
    centre is that of the fingertips at the start of the episode, fixed in the wrist frame."""
    hand_table_collision: bool = True
    """Enables collisions between the hand and the table."""
    hand_self_collision: bool = True
    """Enables collisions between the hand's links."""
    contact_time: float = CONTACT_TIME_S
    """Time constant of the hand's contacts, s; at least two physics steps. With 0.006 the contacts
    of a grasp are about 1 mm deep."""
    impratio: float = 100.0
    """Stiffness of friction in training, relative to normal contact forces (MuJoCo's option of this
    name). With 1 a control step in contact takes half the time on a CPU, but objects creep out of
    every grasp within seconds. Evaluations and grasps always use the default."""
    torsional_friction: float = 0.004
    """Torsional friction of contacts between fingertips and object (condim 4), m: the sliding
    friction times about two thirds of the contact patch's radius. 0: point contacts. The engine
    `jax` supports point contacts only."""
    object_damping: float = 5e-5
    """Damping of the free object, N.s/m and N.m.s/rad. With the default, an object that pivots
    between two fingers swings for about a second."""
    back_off: float = 0.15
    """Initial distance of the wrist from its pose at the heading, backwards along the heading, m.
    """
    back_off_range: tuple[float, float] = (0.05, 0.25)
    """Range of this distance in training, sampled uniformly at every reset, m."""
    initial_speed: float = 0.8
    """Initial speed of the wrist along the heading in training at the largest distance of
    `back_off_range`, m/s. At smaller distances it is proportionally lower. 0: at rest."""
    preshape: bool = True
    """Opens the fingers to the object's width at the heading (`common.hands.closure`) at the start.
    If false, the fingers start in the open pose."""
    preshape_margin: tuple[float, float] = (0.015, 0.06)
    """Distance by which the fingers are opened wider than the object in training, m, sampled
    uniformly at every reset.
    """
    surface_points: int = 256
    """Number of surface points of an object that the policy observes (at most 512)."""
    surface_normals: bool = False
    """Adds to the observation the surface normal at the surface point nearest to each keypoint, and
    the keypoint's height above the tangent plane there. This makes distances more precise, because
    surface points are up to 2 cm apart. Requests may contain normals; `common.task.normals`
    estimates missing ones."""
    trajectory_points: int = 15
    """Number K of waypoints of a wrist trajectory."""
    constraints: tuple[str, ...] = ("heading",)
    """Constraints that the policy supports: it observes them, and requests may contain them."""
    headings: Literal["all", "above", "center"] = "all"
    """Headings in training. `all`: headings for which the table leaves room; `above` (easier):
    those within 30 degrees of straight down, if there are any; `center` (harder): headings by the
    paper's rules alone, with the hand's centre above the table, as in one row of the
    evaluation."""
    own_references: bool = True
    """Replaces half of an object's reference poses and trajectories during training by the policy's
    current grasps. The other half, or all if false, are made by closing the hand around the
    objects."""
    p_together: float = 0.0
    """Probability that an episode with an affordance also gets a wrist trajectory that agrees with
    the affordance, if the object has one. These trajectories are in addition to those of
    `p_trajectory`."""
    aligned_references: bool = False
    """Gives an episode with a reference pose and a wrist trajectory the trajectory to that pose.
    If false, the two are sampled independently, as in the paper, and the trajectory may end at
    another pose."""
    human_paths: float = 0.0
    """Share of the wrist trajectories that are like human reaches: at up to 75 degrees to the
    heading of their grasp, and from 8 to 20 cm away (`common.task.sampling.trajectories`). The
    others, and all of an evaluation, are those of the paper."""
    disturbed_references: float = 0.0
    """Share of the episodes whose reference pose and wrist trajectory have errors as in captured
    data (`common.task.constraints.pose`)."""
    mass_range: tuple[float, float] = (1.0, 1.0)
    """Range of the factor on the object's mass, sampled uniformly at every reset."""
    friction_range: tuple[float, float] = (1.0, 1.0)
    """Range of the sliding friction between hand and object, sampled uniformly at every reset."""
    gain_range: tuple[float, float] = (1.0, 1.0)
    """Range of the factor on the gains of the finger servos, sampled uniformly at every reset."""
    observation: SensorName = "full"
    """Observation of the policy: the full state of the simulator, or the measurements of a robot.
    The latter are joint angles and targets, the wrist, and the object's pose from a tracker
    (`common.task.sensors.tracker`) or a partial cloud of its surface from a depth camera
    (`common.task.sensors.camera`). They contain neither forces nor velocities, but the readings of
    the last `history` control steps."""
    history: int = 8
    """Number of control steps in the observation of a policy with a tracker or a camera, including
    the current step: 2 to 64."""
    sensing: SensingConfig = SensingConfig()
    """The tracker or camera. A policy that observes the full state also gets the object's pose from
    the tracker, unless the tracker has no errors."""
    drop_height: float = 0.05
    """Distance by which an object must be below its height at the start, or at the table's removal,
    to count as fallen, m.
    """
    control: ControlConfig = ControlConfig()
    """Mapping from actions to joint targets."""

    def evaluated(self) -> Self:
        """Returns the task with the physics of evaluations, grasps and exports: stiff friction, no
        end at a fall.
        """
        return dataclasses.replace(self, impratio=type(self).impratio, end_when_fallen=False)

    @property
    def sensed(self) -> bool:
        """True if the policy observes anything but the true state of the simulation."""
        return self.observation != "full" or self.sensing != SensingConfig()
