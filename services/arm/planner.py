"""Grasp motions on an arm: the arm along the motion, or the limit that forbids it."""

import dataclasses
import hashlib
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError, MissingPackageError
from congrasp.common.hands.spec import Hand
from congrasp.common.io.arrays import numbers_in
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.arm import ArmOptions
from congrasp.services.arm.description import arm_file, load_arm
from congrasp.services.arm.robot import (
    Infeasible,
    Pose,
    Robot,
    build_robot,
    default_mount,
    moved_arm,
)
from congrasp.services.export.frames import NOT_LINKS
from congrasp.services.export.motion_file import GraspMotion
from congrasp.services.record.episode import MovedArm

try:
    import mink
except ModuleNotFoundError as error:
    raise MissingPackageError("--arm", error.name or "mink") from None

ACCELERATION = 60.0
"""Limit of every joint's acceleration, rad/s^2 (m/s^2 of slides)."""
POSITION, ANGLE = 0.005, float(np.radians(2.0))
"""Tolerance of the wrist's deviation from its path, m and rad."""
_STARTS, _TRACKED = 24, 5  # random postures to start from, distinct solutions that are followed
_SMOOTHING = 0.02  # standard deviation of the filter that removes contact tremor from the path, s
_ITERATIONS = 80  # from each
# Weight of the middle of the ranges against 1 m, share of the way to it in a step
_POSTURE, _PULL = (
    2e-3,
    0.02,
)
_SAME = 0.05  # rad between two postures, below which they count as one
_AT_END = 2e-3  # rad from the end of a range
_TURN = np.pi  # rad to either side, of joints whose range is larger


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
    starts = solver.starts(rng)
    furthest: tuple[int, str] = (-1, "")
    for start in starts:
        steps, reason, track = solver.track(start)
        if track is not None:
            return track
        furthest = max(furthest, (steps, reason))
    raise Infeasible(furthest[1])


def _smooth(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Path of the wrist (T, 3) and (T, 4) without contact tremor."""
    quaternion = path.rotation.as_quat(scalar_first=True)
    same = np.sum(quaternion[1:] * quaternion[:-1], -1) >= 0
    quaternion[1:] *= np.cumprod(np.where(same, 1.0, -1.0))[:, None]
    steps = _SMOOTHING / path.dt
    position, turns = (
        gaussian_filter1d(values, steps, axis=0, mode="nearest")
        for values in (path.position, quaternion)
    )
    return position, turns / np.linalg.norm(turns, axis=-1, keepdims=True)


class _Solver:
    """mink's tasks and limits for one robot and path."""

    def __init__(self, robot: Robot, path: Path):
        arm, model = robot.arm, robot.model
        self.robot, self.path = robot, path
        self.target = _smooth(path)
        self.lower, self.upper = np.maximum(arm.lower, -_TURN), np.minimum(arm.upper, _TURN)
        self.wrist = mink.FrameTask(
            robot.palm, "body", position_cost=1.0, orientation_cost=0.3, lm_damping=1e-6
        )
        cost = np.zeros(model.nv)
        cost[robot.joints] = _POSTURE
        self.posture = mink.PostureTask(model, cost, gain=_PULL)
        middle = model.qpos0.copy()
        middle[robot.joints] = (self.lower + self.upper) / 2
        self.posture.set_target(middle)
        self.range = mink.ConfigurationLimit(model)
        self.speed = mink.VelocityLimit(model, dict(zip(arm.joints, arm.speed, strict=True)))
        self.configuration = mink.Configuration(model)
        self.body = model.body(robot.palm).id
        self.scene = mujoco.MjData(model)
        low, high = model.jnt_range[:, 0], model.jnt_range[:, 1]
        fingers = np.isin(model.jnt_qposadr, robot.fingers) & model.jnt_limited.astype(bool)
        self.finger_range = np.full((2, model.nq), np.inf) * [[-1], [1]]
        self.finger_range[:, model.jnt_qposadr[fingers]] = low[fingers], high[fingers]

    def whole(self, q: np.ndarray, t: int) -> np.ndarray:
        """Positions (Q,) of the model for arm joints (N,) and the fingers of step t."""
        full = self.robot.model.qpos0.copy()
        full[self.robot.joints], full[self.robot.fingers] = q, self.path.q[t]
        return np.clip(full, *self.finger_range)

    def aim(self, t: int) -> None:
        """Sets the pose of step t as the wrist's target."""
        position, quaternion = self.target
        self.wrist.set_target(
            mink.SE3.from_rotation_and_translation(mink.SO3(quaternion[t]), position[t])
        )

    def errors(self, position: np.ndarray, turn: Rotation) -> tuple[float, float]:
        """Deviation of the wrist from a pose, m and rad."""
        data = self.configuration.data
        now = Rotation.from_matrix(data.xmat[self.body].reshape(3, 3))
        return float(np.linalg.norm(data.xpos[self.body] - position)), float(
            (now.inv() * turn).magnitude()
        )

    def starts(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Distinct postures (N,) at the path's first pose without collisions, those farthest from
        limits first.

        Raises:
          Infeasible: there is no such posture.
        """
        arm = self.robot.arm
        random = rng.uniform(self.lower, self.upper, (_STARTS, len(self.lower)))
        seeds = np.concatenate([arm.postures, (self.lower + self.upper)[None] / 2, random])
        found: list[tuple[float, np.ndarray]] = []
        nearest: tuple[float, str] = (np.inf, "")
        for seed in np.clip(seeds, self.lower, self.upper):
            q, (off, turned) = self._solved(seed)
            if off > POSITION / 5 or turned > ANGLE / 5:
                nearest = min(nearest, (off + 0.3 * turned, self._ends(q) or "the reach"))
            elif touching := self._collision(q, 0):
                nearest = min(nearest, (0.0, touching))
            elif all(np.abs(q - other).max() > _SAME for _, other in found):
                room = np.minimum(q - arm.lower, arm.upper - q) / np.maximum(
                    self.upper - self.lower, 1e-9
                )
                found.append((float(room.min()), q))
                if len(found) == _TRACKED:
                    break
        if not found:
            raise Infeasible(nearest[1])
        return [q for _, q in sorted(found, key=lambda pair: -pair[0])]

    def _solved(self, seed: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
        """Arm joints (N,) at the path's first pose from a posture, and their errors."""
        self.configuration.update(self.whole(seed, 0))
        self.aim(0)
        settled = 0
        for _ in range(_ITERATIONS):
            velocity = mink.solve_ik(
                self.configuration,
                [self.wrist, self.posture],
                1.0,
                "daqp",
                damping=1e-9,
                limits=[self.range],
            )
            self.configuration.integrate_inplace(np.clip(velocity, -0.5, 0.5), 1.0)
            settled = settled + 1 if np.abs(velocity).max() < 1e-2 else 0
            if settled > 3:
                break
        position, turn = self.target[0][0], Rotation.from_quat(self.target[1][0], scalar_first=True)
        return self.configuration.q[self.robot.joints].copy(), self.errors(position, turn)

    def track(self, start: np.ndarray) -> tuple[int, str, Track | None]:
        """Follows the path from a posture; returns the number of steps, the violated limit, and a
        complete track.
        """
        path, robot = self.path, self.robot
        q = np.zeros((len(path.position), len(start)))
        q[0] = start
        self.configuration.update(self.whole(start, 0))
        worst = np.array(self.errors(path.position[0], path.rotation[0]))
        for t in range(1, len(q)):
            self.aim(t)
            velocity = mink.solve_ik(
                self.configuration,
                [self.wrist, self.posture],
                path.dt,
                "daqp",
                damping=1e-9,
                limits=[self.range, self.speed],
            )
            q[t] = q[t - 1] + path.dt * velocity[robot.joints]
            self.configuration.update(self.whole(q[t], t))
            errors = self.errors(path.position[t], path.rotation[t])
            if errors[0] > POSITION or errors[1] > ANGLE:
                return t, self._ends(q[t]) or self._fast(velocity) or self._slack(t), None
            if touching := self._collision(q[t], t):
                return t, touching, None
            worst = np.maximum(worst, errors)
        speed = np.diff(q, axis=0) / path.dt
        acceleration = np.abs(np.diff(speed, axis=0)).max(0) / path.dt
        if (acceleration > ACCELERATION).any():
            return (
                len(q),
                f"the acceleration of {robot.arm.joints[int(acceleration.argmax())]}",
                None,
            )
        shares = np.abs(speed).max(0) / robot.arm.speed
        return len(q), "", Track(q, float(worst[0]), float(worst[1]), shares, acceleration)

    def _ends(self, q: np.ndarray) -> str:
        """Describes the joint at the end of its range; empty if there is none."""
        room = np.minimum(q - self.robot.arm.lower, self.robot.arm.upper - q)
        joint = int(room.argmin())
        return f"the range of {self.robot.arm.joints[joint]}" if room[joint] < _AT_END else ""

    def _fast(self, velocity: np.ndarray) -> str:
        """Describes the joint at its speed limit; empty if there is none."""
        shares = np.abs(velocity[self.robot.joints]) / self.robot.arm.speed
        joint = int(shares.argmax())
        return f"the speed of {self.robot.arm.joints[joint]}" if shares[joint] > 0.99 else ""

    def _slack(self, t: int) -> str:
        """Violated limit: the path's acceleration if the arm is on the smooth path, else the
        reach.
        """
        off = np.linalg.norm(self.configuration.data.xpos[self.body] - self.target[0][t])
        return "the acceleration of the wrist" if off < POSITION / 2 else "the reach"

    def _collision(self, q: np.ndarray, t: int) -> str:
        """Describes the collision at step t; empty if there is none."""
        path, data = self.path, self.scene
        self.robot.place(
            data,
            self.whole(q, t),
            path.object_position[t],
            path.object_quaternion[t],
            path.table[t],
        )
        touching = self.robot.collision(data)
        return f"collision of {touching}" if touching else ""


_FAR_BELOW = -10.0  # m, of a table that was removed


@dataclasses.dataclass(frozen=True, eq=False)
class ArmMotion:
    """An arm along a grasp motion."""

    moved: MovedArm
    base: Pose
    """Relative to the object on the table."""
    track: Track

    def facts(self) -> dict[str, Any]:
        """Arm, base, errors and shares of the limits, for `result.json`."""
        yaw = float(self.base.rotation.as_euler("xyz", degrees=True)[2])
        fastest = int(self.track.speed.argmax())
        return {
            "arm": self.moved.name,
            "arm_base": [*(round(float(x), 6) for x in self.base.position), round(yaw, 6)],
            "arm_error_mm": 1e3 * self.track.position_error,
            "arm_error_deg": float(np.degrees(self.track.rotation_error)),
            "arm_speed_share": float(self.track.speed[fastest]),
            "arm_speed_joint": str(self.moved.joint_names[fastest]),
            "arm_acceleration": float(self.track.acceleration.max()),
        }

    def note(self) -> str:
        """Describes the arm's distance from its limits."""
        facts = self.facts()
        off = f"{facts['arm_error_mm']:.1f} mm and {facts['arm_error_deg']:.1f}°"
        speed = (
            f"{facts['arm_speed_joint']} at {100 * facts['arm_speed_share']:.0f}% of its speed "
            f"limit at most"
        )
        return f"{facts['arm']} carries the hand within {off} of its path, {speed}"


class ArmPlanner:
    """Plans the joints of an arm with a hand along grasp motions."""

    def __init__(self, options: ArmOptions, hand: Hand, seed: int = 0):
        """Reads the arm.

        Args:
          options: file, base, flange, mount and speeds.
          hand: the hand that it carries.
          seed: seed of the initial postures.

        Raises:
          CongraspError: the arm cannot be read, or an option is not valid.
        """
        file = arm_file(options.arm)
        self._arm = load_arm(file, options.flange, options.arm_speed)
        x, y, z, yaw = _numbers("--base", options.base, "X Y Z YAW")
        self._base = Pose(np.array([x, y, z]), Rotation.from_euler("z", yaw, degrees=True))
        self._mount = default_mount(hand)
        if options.mount:
            given = _numbers("--mount", options.mount, "X Y Z ROLL PITCH YAW")
            self._mount = Pose(given[:3], Rotation.from_euler("xyz", given[3:], degrees=True))
        self._hand, self._seed = hand, seed
        self._robot: tuple[GraspObject, Robot] | None = None
        self.identity = (
            hashlib.sha256(file.read_bytes()).hexdigest(),
            dataclasses.astuple(options),
        )

    @property
    def name(self) -> str:
        """The arm's name."""
        return self._arm.name

    @property
    def side(self) -> float:
        """Side of the object on which the base is, rad from the x axis of the world frame."""
        return float(np.arctan2(self._base.position[1], self._base.position[0]))

    def plan(self, obj: GraspObject, motion: GraspMotion) -> ArmMotion:
        """Computes the joints along a motion.

        Raises:
          Infeasible: the arm cannot follow it.
        """
        if self._robot is None or self._robot[0] is not obj:
            self._robot = obj, build_robot(self._arm, self._hand, self._mount, obj)
        robot = self._robot[1]
        start = motion.object_position[0].astype(float) * [1.0, 1.0, 0.0]
        base = dataclasses.replace(self._base, position=self._base.position + start)
        track = follow(robot, _path(motion, base), np.random.default_rng(self._seed))
        arm = moved_arm(
            robot, track.q, base, self._mount, {*motion.link_names.tolist(), *NOT_LINKS}
        )
        return ArmMotion(arm, self._base, track)


def _path(motion: GraspMotion, base: Pose) -> Path:
    """Wrist, object and table of a motion in the frame of a base that is fixed in the world."""
    back = base.rotation.inv()
    wrist = Rotation.from_quat(motion.wrist_quaternion, scalar_first=True)
    turned = back * Rotation.from_quat(motion.object_quaternion, scalar_first=True)
    return Path(
        back.apply(motion.wrist_position - base.position),
        back * wrist,
        motion.joint_position.astype(float),
        back.apply(motion.object_position - base.position),
        turned.as_quat(scalar_first=True),
        np.where(motion.table, -base.position[2], _FAR_BELOW),
        motion.control_dt,
    )


def _numbers(option: str, text: str, form: str) -> np.ndarray:
    """Parses the numbers of an option, as many as its form has words.

    Raises:
      CongraspError: the text does not match the form.
    """
    found = numbers_in(text)
    if len(found) != len(form.split()):
        raise CongraspError(f"{option} is '{text}'.", f'Write "{form}" in metres and degrees.')
    return found
