"""Joints of an arm along a path of the wrist, by inverse kinematics within the arm's limits."""

import dataclasses

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from congrasp.common.errors import MissingPackageError
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.arm.robot import Infeasible, Robot

try:
    import mink
except ModuleNotFoundError as error:
    raise MissingPackageError("--arm", error.name or "mink") from None

_MAX_ACCELERATION = 60.0
"""Limit of every joint's acceleration, rad/s^2 (m/s^2 of slides)."""
POSITION_TOLERANCE_M = 0.005
"""Tolerance of the wrist's deviation from its path, m."""
ANGLE_TOLERANCE_RAD = float(np.radians(2.0))
"""Tolerance of the wrist's orientation, rad."""
_START_POSITION_TOLERANCE_M = POSITION_TOLERANCE_M / 5
_START_ANGLE_TOLERANCE_RAD = ANGLE_TOLERANCE_RAD / 5
_RANDOM_SEEDS = 24  # random postures from which starts are sought
_MAX_STARTS = 5  # distinct starts that are followed
_SMOOTHING_S = 0.02  # standard deviation of the filter that removes contact tremor from the path
_MAX_ITERATIONS = 80  # of the inverse kinematics, from each start
_SETTLED_ITERATIONS = 3  # of small steps, after which the inverse kinematics has converged
_SETTLED_STEP_RAD = 1e-2  # largest small step of a joint
_MAX_STEP_RAD = 0.5  # of a joint in one iteration
_POSTURE_WEIGHT = 2e-3  # of a joint's distance (rad) from the middle, against 1 per m of the wrist
_POSTURE_GAIN = 0.02  # share of the way to the middle in a step
_ANGLE_WEIGHT_M_PER_RAD = 0.3  # of the wrist's rotation
_DISTINCT_RAD = 0.05  # largest difference of two postures that count as one
_AT_END_RAD = 2e-3  # distance from a limit below which a joint is at the end of its range
_AT_SPEED = 0.99  # share of a speed limit
_MAX_RANGE_RAD = np.pi  # to either side, of joints whose range is larger


@dataclasses.dataclass(frozen=True)
class Path:
    """T poses of the wrist, of the object and of the table in the frame of the arm's base, a
    control step apart.
    """

    position: np.ndarray
    """(T, 3) m."""
    rotation: Rotation
    """T of the wrist."""
    q: np.ndarray
    """(T, F) rad, joints of the fingers."""
    object_position: np.ndarray
    """(T, 3) m."""
    object_quaternion: np.ndarray
    """(T, 4) w x y z."""
    table: np.ndarray
    """(T,) m, the table's height."""
    dt: float
    """Control step, s."""


@dataclasses.dataclass(frozen=True)
class Track:
    """Joints of an arm along a path."""

    q: np.ndarray
    """(T, N) rad (m of slides)."""
    position_error: float
    """m, greatest distance of the wrist from its path."""
    rotation_error: float
    """rad, the same of its orientation."""
    speed: np.ndarray
    """(N,) greatest speed of each joint as a share of its limit."""
    acceleration: np.ndarray
    """(N,) greatest acceleration of each joint, rad/s^2 (m/s^2 of slides)."""


@dataclasses.dataclass(frozen=True)
class _Failure:
    """Step at which the arm leaves a path."""

    step: int
    reason: str
    """The limit that it violates there."""


def follow(robot: Robot, path: Path, rng: np.random.Generator) -> Track:
    """Computes the joints along a path.

    Several starts are tried, those far from joint limits first, until one reaches the path's end.

    Args:
      robot: arm, hand and scene.
      path: path of the wrist.
      rng: generator of the initial postures.

    Raises:
      Infeasible: the path leads out of the arm's reach, or no start leads to its end; the message
        names the limit that the start with the longest way violates.
    """
    distance = float(np.linalg.norm(path.position, axis=1).max())
    if distance > robot.wrist_reach + POSITION_TOLERANCE_M:
        raise Infeasible("the reach")
    solver = _Solver(robot, path)
    failures = []
    for start in solver.starts(rng):
        result = solver.track(start)
        if isinstance(result, Track):
            return result
        failures.append(result)
    furthest = max(failures, key=lambda failure: (failure.step, failure.reason))
    raise Infeasible(furthest.reason)


def _smooth(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 3) and quaternions (T, 4) of the wrist without contact tremor."""
    quaternion = path.rotation.as_quat(scalar_first=True)
    # q and -q are one rotation: the filter needs neighbours with the same sign.
    same_sign = np.sum(quaternion[1:] * quaternion[:-1], -1) >= 0
    quaternion[1:] *= np.cumprod(np.where(same_sign, 1.0, -1.0))[:, None]
    sigma = _SMOOTHING_S / path.dt
    position = gaussian_filter1d(path.position, sigma, axis=0, mode="nearest")
    smoothed = gaussian_filter1d(quaternion, sigma, axis=0, mode="nearest")
    return position, smoothed / np.linalg.norm(smoothed, axis=-1, keepdims=True)


class _Solver:
    """mink's tasks and limits for one robot and path.

    The model's positions and velocities (Q,) are those of the arm's N joints and the hand's F.
    """

    def __init__(self, robot: Robot, path: Path):
        self.robot = robot
        self.path = path
        self.target_position, self.target_quaternion = _smooth(path)
        self.lower = np.maximum(robot.arm.lower, -_MAX_RANGE_RAD)
        self.upper = np.minimum(robot.arm.upper, _MAX_RANGE_RAD)
        model = robot.model
        self.wrist = mink.FrameTask(
            robot.palm,
            "body",
            position_cost=1.0,
            orientation_cost=_ANGLE_WEIGHT_M_PER_RAD,
            lm_damping=1e-6,
        )
        self.posture = self._middle_posture()
        self.range = mink.ConfigurationLimit(model)
        speeds = dict(zip(robot.arm.joints, robot.arm.speed, strict=True))
        self.speed = mink.VelocityLimit(model, speeds)
        self.configuration = mink.Configuration(model)
        self.body = model.body(robot.palm).id
        self.scene = mujoco.MjData(model)
        self.finger_range = _finger_range(robot)

    def _middle_posture(self) -> mink.PostureTask:
        """Returns a task that pulls the arm towards the middle of its ranges."""
        model = self.robot.model
        cost = np.zeros(model.nv)
        cost[self.robot.joints] = _POSTURE_WEIGHT
        task = mink.PostureTask(model, cost, gain=_POSTURE_GAIN)
        middle = model.qpos0.copy()
        middle[self.robot.joints] = (self.lower + self.upper) / 2
        task.set_target(middle)
        return task

    def model_positions(self, q: np.ndarray, t: int) -> np.ndarray:
        """Positions (Q,) of the model for arm joints (N,) and the fingers of step t."""
        positions = self.robot.model.qpos0.copy()
        positions[self.robot.joints] = q
        positions[self.robot.fingers] = self.path.q[t]
        return np.clip(positions, *self.finger_range)

    def aim(self, t: int) -> None:
        """Sets the pose of step t as the wrist's target."""
        rotation = mink.SO3(self.target_quaternion[t])
        pose = mink.SE3.from_rotation_and_translation(rotation, self.target_position[t])
        self.wrist.set_target(pose)

    def errors(self, position: np.ndarray, rotation: Rotation) -> tuple[float, float]:
        """Deviation of the wrist from a pose, m and rad."""
        data = self.configuration.data
        current = Rotation.from_matrix(data.xmat[self.body].reshape(3, 3))
        distance = float(np.linalg.norm(data.xpos[self.body] - position))
        angle = float((current.inv() * rotation).magnitude())
        return distance, angle

    def starts(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Distinct postures (N,) at the path's first pose without collisions, those farthest from
        limits first.

        Raises:
          Infeasible: there is no such posture.
        """
        random = rng.uniform(self.lower, self.upper, (_RANDOM_SEEDS, len(self.lower)))
        middle = (self.lower + self.upper)[None] / 2
        seeds = np.concatenate([self.robot.arm.postures, middle, random])
        starts: list[np.ndarray] = []
        failures: list[tuple[float, str]] = []
        for seed in np.clip(seeds, self.lower, self.upper):
            q = self._solve(seed)
            failure = self._start_failure(q)
            if failure is not None:
                failures.append(failure)
                continue
            if any(np.abs(q - start).max() <= _DISTINCT_RAD for start in starts):
                continue
            starts.append(q)
            if len(starts) == _MAX_STARTS:
                break
        if not starts:
            _, reason = min(failures)
            raise Infeasible(reason)
        return sorted(starts, key=self._distance_from_limits, reverse=True)

    def _start_failure(self, q: np.ndarray) -> tuple[float, str] | None:
        """Returns why the path cannot start at the posture in the configuration; None if it can.

        Args:
          q: (N,) arm joints of this posture.

        Returns:
          The wrist's deviation, m, with that of its orientation by its weight, or 0 for a
          collision; and the violated limit.
        """
        distance, angle = self._start_errors()
        if distance > _START_POSITION_TOLERANCE_M or angle > _START_ANGLE_TOLERANCE_RAD:
            reason = self._joint_at_end(q) or "the reach"
            return distance + _ANGLE_WEIGHT_M_PER_RAD * angle, reason
        collision = self._collision(q, 0)
        if collision:
            return 0.0, collision
        return None

    def _solve(self, seed: np.ndarray) -> np.ndarray:
        """Moves the configuration from a posture (N,) to the path's first pose, as far as it can;
        returns the arm joints (N,).
        """
        self.configuration.update(self.model_positions(seed, 0))
        self.aim(0)
        small_steps = 0
        for _ in range(_MAX_ITERATIONS):
            step = mink.solve_ik(
                self.configuration,
                [self.wrist, self.posture],
                1.0,
                "daqp",
                damping=1e-9,
                limits=[self.range],
            )
            self.configuration.integrate_inplace(np.clip(step, -_MAX_STEP_RAD, _MAX_STEP_RAD), 1.0)
            is_small = np.abs(step).max() < _SETTLED_STEP_RAD
            small_steps = small_steps + 1 if is_small else 0
            if small_steps > _SETTLED_ITERATIONS:
                break
        return self.configuration.q[self.robot.joints].copy()

    def _start_errors(self) -> tuple[float, float]:
        """Deviation of the wrist from the smooth path's first pose, m and rad."""
        rotation = Rotation.from_quat(self.target_quaternion[0], scalar_first=True)
        return self.errors(self.target_position[0], rotation)

    def _distance_from_limits(self, q: np.ndarray) -> float:
        """Smallest distance of a joint from its limits, as a share of its range."""
        arm = self.robot.arm
        distance = np.minimum(q - arm.lower, arm.upper - q)
        return float((distance / np.maximum(self.upper - self.lower, 1e-9)).min())

    def track(self, start: np.ndarray) -> Track | _Failure:
        """Follows the path from a posture to its end, or to the first violated limit."""
        path = self.path
        q = np.zeros((len(path.position), len(start)))
        q[0] = start
        self.configuration.update(self.model_positions(start, 0))
        largest_errors = np.array(self.errors(path.position[0], path.rotation[0]))
        for t in range(1, len(q)):
            velocity = self._velocity(t)
            q[t] = q[t - 1] + path.dt * velocity[self.robot.joints]
            self.configuration.update(self.model_positions(q[t], t))
            distance, angle = self.errors(path.position[t], path.rotation[t])
            if distance > POSITION_TOLERANCE_M or angle > ANGLE_TOLERANCE_RAD:
                joint = self._joint_at_end(q[t]) or self._joint_at_speed(velocity)
                return _Failure(t, joint or self._limit_of_path(t))
            collision = self._collision(q[t], t)
            if collision:
                return _Failure(t, collision)
            largest_errors = np.maximum(largest_errors, (distance, angle))
        speed = np.diff(q, axis=0) / path.dt
        acceleration = np.abs(np.diff(speed, axis=0)).max(0) / path.dt
        if (acceleration > _MAX_ACCELERATION).any():
            joint = self.robot.arm.joints[int(acceleration.argmax())]
            return _Failure(len(q), f"the acceleration of {joint}")
        return Track(
            q=q,
            position_error=float(largest_errors[0]),
            rotation_error=float(largest_errors[1]),
            speed=np.abs(speed).max(0) / self.robot.arm.speed,
            acceleration=acceleration,
        )

    def _velocity(self, t: int) -> np.ndarray:
        """Velocities (Q,) of the model towards the pose of step t."""
        self.aim(t)
        return mink.solve_ik(
            self.configuration,
            [self.wrist, self.posture],
            self.path.dt,
            "daqp",
            damping=1e-9,
            limits=[self.range, self.speed],
        )

    def _joint_at_end(self, q: np.ndarray) -> str:
        """Describes the joint at the end of its range; empty if there is none."""
        arm = self.robot.arm
        distance = np.minimum(q - arm.lower, arm.upper - q)
        joint = int(distance.argmin())
        if distance[joint] >= _AT_END_RAD:
            return ""
        return f"the range of {arm.joints[joint]}"

    def _joint_at_speed(self, velocity: np.ndarray) -> str:
        """Describes the joint at its speed limit; empty if there is none."""
        arm = self.robot.arm
        shares = np.abs(velocity[self.robot.joints]) / arm.speed
        joint = int(shares.argmax())
        if shares[joint] <= _AT_SPEED:
            return ""
        return f"the speed of {arm.joints[joint]}"

    def _limit_of_path(self, t: int) -> str:
        """Limit that a wrist away from its path violates, if no joint is at a limit: the wrist's
        acceleration if it is on the smooth path, else the reach.
        """
        wrist = self.configuration.data.xpos[self.body]
        distance = np.linalg.norm(wrist - self.target_position[t])
        if distance < POSITION_TOLERANCE_M / 2:
            return "the acceleration of the wrist"
        return "the reach"

    def _collision(self, q: np.ndarray, t: int) -> str:
        """Describes the collision at step t; empty if there is none."""
        self.robot.place(
            self.scene,
            self.model_positions(q, t),
            self.path.object_position[t],
            self.path.object_quaternion[t],
            self.path.table[t],
        )
        pair = self.robot.collision(self.scene)
        return f"collision of {pair}" if pair else ""


def _finger_range(robot: Robot) -> np.ndarray:
    """(2, Q) limits of the model's positions: those of the fingers, else infinite."""
    model = robot.model
    fingers = np.isin(model.jnt_qposadr, robot.fingers) & model.jnt_limited.astype(bool)
    limits = np.full((2, model.nq), np.inf) * [[-1], [1]]
    limits[:, model.jnt_qposadr[fingers]] = model.jnt_range[fingers].T
    return limits
