"""Written settings of the task: control, sensing, timing and sampling. Constraints read these.

The string under a field is its help on the command line.
"""

import dataclasses
from typing import Literal, Self

from congrasp.common.hands.spec import CONTACT_TIME
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
    """Largest distance of the wrist's target from the wrist, m: at kp/kv = 20/s a speed of 0.8
    m/s.
    """
    approach_position_limit: float = 0.02
    """The same while the table is present: 0.4 m/s, no faster than the end of a reach."""
    closing_position_limit: float = 0.015
    """The same within `closing_distance` of the object, while the table is present: 0.3 m/s."""
    closing_distance: float = 0.04
    """Distance between the hand's keypoints and the object, m, below which the hand approaches
    slowly.
    """
    guidance_rotation_limit: float = 0.3
    """Largest rotation of the wrist's target from the wrist, rad: 5 rad/s."""
    wrist_acceleration: float = 15.0
    """Greatest linear acceleration by the wrist's servos, m/s^2; with its inertia this also limits
    their force. 0: no limit."""
    wrist_angular_acceleration: float = 150.0
    """Greatest angular acceleration by the wrist's servos, rad/s^2. 0: no limit."""
    hold_acceleration: float = 1 / 3
    """Share of both limits after the table is removed, except for braking; it reduces the wrist's
    tremor.
    """
    load_rate: float = 60.0
    """Inverse time constant (1/s) of the observer of the wrist's load. Its estimate is added to the
    wrist's targets after the table is removed, so that the limits on acceleration do not limit
    weight. 0: no compensation."""
    lookahead: int = 1
    """Number of waypoints from the nearest one to the guidance (0 is the paper's ablation without
    feed-forward).
    """
    follow_object: bool = False
    """Guides relative to the object's current pose instead of its pose at the start of the
    episode.
    """
    finger_guidance: float = 0.0
    """Angle by which finger targets close in each control step from the middle of the approach on,
    rad; 0 leaves the fingers to the action (the paper's method)."""


@dataclasses.dataclass(frozen=True)
class SensingConfig:
    """Tracker that measures the object's pose (`common.task.sensors.tracker`), or camera that shows
    its surface (`common.task.sensors.camera`): ranges, drawn uniformly at every reset.

    With zeros, the default, either is perfect and measures at every control step.
    """

    period: tuple[float, float] = (0.0, 0.0)
    """Seconds between two samples: 0.033 at 30 Hz. Values up to a control step give one sample a
    step.
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
    """Standard deviation of each coordinate of a constant error of all samples of an episode, m."""
    rotation_bias: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of a constant rotation of all samples of an episode about each axis,
    rad.
    """
    settle: float = 0.0
    """The wrist is guided by the mean of the object's poses until one is this far from it, m, or
    the table is removed; 0: by the first pose."""
    single_image: float = 0.0
    """Share of the episodes in which the camera takes one image, before the reach, and none after
    it.
    """
    camera_distance: tuple[float, float] = (0.4, 0.8)
    """Distance of the camera from the object at the start, m."""
    camera_elevation: tuple[float, float] = (0.3, 1.2)
    """Elevation of the camera above the object, rad; at most 1.5."""
    camera_azimuth: tuple[float, float] = (-3.15, 3.15)
    """Direction from the object to the camera about the vertical, from the world's x axis, rad."""
    latency: tuple[float, float] = (0.0, 0.0)
    """Seconds until the servos follow a target, rounded to control steps, of which there are fewer
    than `history`.
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
    """Training draws the length of the hold between `hold_steps` and this, short ones more
    often.
    """
    end_when_fallen: bool = True
    """Ends holds longer than `hold_steps` as soon as the object has fallen."""
    dynamic_center: bool = True
    """Computes the hand centre from the current fingertips; false is the paper's ablation: from the
    fingertips at the start of the episode, fixed in the wrist frame."""
    hand_table_collision: bool = True
    """Enables collisions between the hand and the table."""
    hand_self_collision: bool = True
    """Enables collisions between the hand's links."""
    contact_time: float = CONTACT_TIME
    """Time constant of the hand's contacts, s; at least two physics steps. At 0.006 a grasp's
    contacts are about 1 mm deep."""
    impratio: float = 100.0
    """Stiffness of friction in training, relative to normal contact forces (MuJoCo's option). With
    1 a control step in contact takes half the time on a CPU, but objects creep out of every grasp
    within seconds. Evaluations and grasps always have the default."""
    torsional_friction: float = 0.004
    """Torsional friction of contacts of fingertips with the object (condim 4), m: the sliding
    friction times about two thirds of the contact patch's radius. 0: point contacts. The engine
    `jax` supports point contacts only."""
    object_damping: float = 5e-5
    """Damping of the free object, N.s/m and N.m.s/rad: an object that pivots between two fingers
    swings for about a second."""
    back_off: float = 0.15
    """Distance from the aligned wrist to its start, against the heading direction, m."""
    back_off_range: tuple[float, float] = (0.05, 0.25)
    """The same in training, drawn uniformly at every reset."""
    initial_speed: float = 0.8
    """Largest initial speed of the wrist along the heading in training, m/s. It is reached at the
    far end of `back_off_range` and is proportionally lower nearer by. 0: at rest."""
    preshape: bool = True
    """Opens the fingers to the object's width at the heading (`common.hands.closure`) at the start;
    otherwise they begin in the open pose."""
    preshape_margin: tuple[float, float] = (0.015, 0.06)
    """Distance by which the fingers are opened wider than the object in training, m, drawn
    uniformly at every reset.
    """
    surface_points: int = 256
    """Surface points of an object that the policy observes (at most 512)."""
    surface_normals: bool = False
    """Adds to the observation the surface's normal at each keypoint's nearest surface point, and
    the keypoint's height above the tangent plane there: points alone lie up to 2 cm apart. Requests
    may contain normals (`common.task.normals` estimates missing ones)."""
    trajectory_points: int = 15
    """K, waypoints of a wrist trajectory."""
    constraints: tuple[str, ...] = ("heading",)
    """Constraints that the policy supports: it observes them, and requests may contain them."""
    headings: Literal["all", "above", "center"] = "all"
    """`above` keeps approach directions within 30 degrees of straight down, where there are any
    (easier); `center` takes the paper's rules only, with the hand's centre above the table (harder:
    a row of the evaluation)."""
    own_references: bool = True
    """Regenerates half of an object's reference poses and trajectories from the policy's current
    grasps during training. The others, or all of them if false, come from closing the hand around
    the objects."""
    p_together: float = 0.0
    """Probability that an episode with an affordance also gets a wrist trajectory that agrees with
    it, where the object has one. These are in addition to those of `p_trajectory`."""
    aligned_references: bool = False
    """Gives an episode with a reference pose and a wrist trajectory the trajectory to that pose.
    Otherwise the two are drawn independently, as in the paper, and the trajectory may end
    elsewhere."""
    human_paths: float = 0.0
    """Share of the wrist trajectories that come as people reach, at up to 75 degrees to the heading
    of their grasp and from 8 to 20 cm (`common.task.sampling.trajectories`); the others come as in
    the paper. Evaluations have those of the paper."""
    disturbed_references: float = 0.0
    """Share of the episodes whose reference pose and wrist trajectory are disturbed like captured
    ones (`common.task.constraints.pose`)."""
    mass_range: tuple[float, float] = (1.0, 1.0)
    """Factors on the object's mass, drawn uniformly at every reset."""
    friction_range: tuple[float, float] = (1.0, 1.0)
    """Sliding friction between hand and object, drawn uniformly at every reset."""
    gain_range: tuple[float, float] = (1.0, 1.0)
    """Factors on the finger servos' gains, drawn uniformly at every reset."""
    observation: SensorName = "full"
    """Observation of the policy: the full state of the simulator, or the sensors of a robot: joint
    angles and targets, the wrist, and the object's pose from a tracker
    (`common.task.sensors.tracker`) or a partial cloud of its surface from a depth camera
    (`common.task.sensors.camera`); no forces and no velocities, but the last `history` steps."""
    history: int = 8
    """Control steps in a tracked or camera observation, including the current one: 2 to 64."""
    sensing: SensingConfig = SensingConfig()
    """The tracker or camera. A policy that observes the full state also gets the object's pose from
    the tracker, unless it is perfect."""
    drop_height: float = 0.05
    """Distance below the object's height at the start, or at the table's removal, at which it
    counts as fallen, m.
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
