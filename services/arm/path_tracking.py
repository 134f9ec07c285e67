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

ACCELERATION = 60.0
"""Limit of every joint's acceleration, rad/s^2 (m/s^2 of slides)."""
POSITION = 0.005
"""Tolerance of the wrist's deviation from its path, m."""
ANGLE = float(np.radians(2.0))
"""Tolerance of the wrist's orientation, rad."""
_START_POSITION = POSITION / 5
_START_ANGLE = ANGLE / 5
_RANDOM_STARTS = 24
_MAX_TRACKED = 5  # distinct starts that are followed
_SMOOTHING_S = 0.02  # standard deviation of the filter that removes contact tremor from the path
_MAX_ITERATIONS = 80  # of the inverse kinematics, from each start
_SETTLED_ITERATIONS = 3  # of small steps, after which the inverse kinematics has converged
_SETTLED_STEP = 1e-2  # rad
_MAX_STEP = 0.5  # rad
_POSTURE_WEIGHT = 2e-3  # of the middle of the ranges, against 1 m
_POSTURE_GAIN = 0.02  # share of the way to the middle in a step
_ANGLE_WEIGHT = 0.3  # m/rad
_DISTINCT_RAD = 0.05  # between two postures, below which they count as one
_AT_END_RAD = 2e-3  # from the end of a range
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
    """(T, F) rad, the fingers."""
    object_position: np.ndarray
    """(T, 3) m."""
    object_quaternion: np.ndarray
    """(T, 4) w x y z."""
    table: np.ndarray
    """(T,) m, the table's height."""
    dt: float
    """s."""


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
    """Step at which the arm leaves a path, and the limit that it violates there."""

    step: int
    reason: str


def follow(robot: Robot, path: Path, rng: np.random.Generator) -> Track:
    """Computes the joints along a path, from the first start that reaches its end; those far from
    joint limits first.

    Args:
      robot: arm, hand and scene.
      path: path of the wrist.
      rng: generator of the initial postures.

    Raises:
      Infeasible: no start leads to the path's end.
    """
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
    """Path of the wrist (T, 3) and (T, 4) without contact tremor."""
    quaternion = path.rotation.as_quat(scalar_first=True)
    same_sign = np.sum(quaternion[1:] * quaternion[:-1], -1) >= 0
    quaternion[1:] *= np.cumprod(np.where(same_sign, 1.0, -1.0))[:, None]
    sigma = _SMOOTHING_S / path.dt
    position = gaussian_filter1d(path.position, sigma, axis=0, mode="nearest")
    smoothed = gaussian_filter1d(quaternion, sigma, axis=0, mode="nearest")
    return position, smoothed / np.linalg.norm(smoothed, axis=-1, keepdims=True)


class _Solver:
    """mink's tasks and limits for one robot and path."""

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
            orientation_cost=_ANGLE_WEIGHT,
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
        """Pulls the arm towards the middle of its ranges."""
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
        random = rng.uniform(self.lower, self.upper, (_RANDOM_STARTS, len(self.lower)))
        middle = (self.lower + self.upper)[None] / 2
        seeds = np.concatenate([self.robot.arm.postures, middle, random])
        starts: list[np.ndarray] = []
        failures: list[tuple[float, str]] = []
        for seed in np.clip(seeds, self.lower, self.upper):
            q = self._solve(seed)
            distance, angle = self._start_errors()
            if distance > _START_POSITION or angle > _START_ANGLE:
                reason = self._joint_at_end(q) or "the reach"
                failures.append((distance + _ANGLE_WEIGHT * angle, reason))
                continue
            collision = self._collision(q, 0)
            if collision:
                failures.append((0.0, collision))
                continue
            if any(np.abs(q - start).max() <= _DISTINCT_RAD for start in starts):
                continue
            starts.append(q)
            if len(starts) == _MAX_TRACKED:
                break
        if not starts:
            _, reason = min(failures)
            raise Infeasible(reason)
        return sorted(starts, key=self._distance_from_limits, reverse=True)

    def _solve(self, seed: np.ndarray) -> np.ndarray:
        """Moves from a posture to the path's first pose; returns the arm joints (N,)."""
        self.configuration.update(self.model_positions(seed, 0))
        self.aim(0)
        settled = 0
        for _ in range(_MAX_ITERATIONS):
            step = mink.solve_ik(
                self.configuration,
                [self.wrist, self.posture],
                1.0,
                "daqp",
                damping=1e-9,
                limits=[self.range],
            )
            self.configuration.integrate_inplace(np.clip(step, -_MAX_STEP, _MAX_STEP), 1.0)
            is_small = np.abs(step).max() < _SETTLED_STEP
            settled = settled + 1 if is_small else 0
            if settled > _SETTLED_ITERATIONS:
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
        worst = np.array(self.errors(path.position[0], path.rotation[0]))
        for t in range(1, len(q)):
            velocity = self._velocity(t)
            q[t] = q[t - 1] + path.dt * velocity[self.robot.joints]
            self.configuration.update(self.model_positions(q[t], t))
            distance, angle = self.errors(path.position[t], path.rotation[t])
            if distance > POSITION or angle > ANGLE:
                reason = self._joint_at_end(q[t]) or self._joint_at_speed(velocity) or self._lag(t)
                return _Failure(t, reason)
            collision = self._collision(q[t], t)
            if collision:
                return _Failure(t, collision)
            worst = np.maximum(worst, (distance, angle))
        speed = np.diff(q, axis=0) / path.dt
        acceleration = np.abs(np.diff(speed, axis=0)).max(0) / path.dt
        if (acceleration > ACCELERATION).any():
            joint = self.robot.arm.joints[int(acceleration.argmax())]
            return _Failure(len(q), f"the acceleration of {joint}")
        return Track(
            q=q,
            position_error=float(worst[0]),
            rotation_error=float(worst[1]),
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
        return f"the range of {arm.joints[joint]}" if distance[joint] < _AT_END_RAD else ""

    def _joint_at_speed(self, velocity: np.ndarray) -> str:
        """Describes the joint at its speed limit; empty if there is none."""
        arm = self.robot.arm
        shares = np.abs(velocity[self.robot.joints]) / arm.speed
        joint = int(shares.argmax())
        return f"the speed of {arm.joints[joint]}" if shares[joint] > _AT_SPEED else ""

    def _lag(self, t: int) -> str:
        """Violated limit: the path's acceleration if the arm is on the smooth path, else the
        reach.
        """
        wrist = self.configuration.data.xpos[self.body]
        distance = np.linalg.norm(wrist - self.target_position[t])
        return "the acceleration of the wrist" if distance < POSITION / 2 else "the reach"

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
