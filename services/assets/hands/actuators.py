"""The drive of a hand from its file: gains and limits of joints and motors, proposed if missing."""

import dataclasses

import numpy as np

from congrasp.common.hands.spec import Coupling, Joint, Motor
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.couplings import couplings
from congrasp.services.assets.hands.reading import listed
from congrasp.services.assets.hands.servos import Servo, servos
from congrasp.services.assets.hands.tendons import relative_limits

FINGERTIP_FORCE = 15.0
"""Force with which a joint without a torque limit can press its fingertip, N."""
LARGEST_FORCE = 40.0
"""Fingertip force above which a torque limit is implausible, N."""
_FULL_TORQUE_ERROR = 0.3
"""Error at which a joint reaches its full torque if the file has no gain, rad."""
_MAX_DAMPING_TIME = 0.1
"""Time constant of damping, s."""
MIN_LEVER = 0.02
"""Least distance of a joint from the tip that it moves, from which torques follow, m."""
_DEFAULT_ARMATURE = 5e-4
"""Armature of a joint without one, kg.m^2."""
_MIN_INERTIA = 1e-6
"""Inertia that a motor moves, kg.m^2."""
_DAMPING_FACTOR = 1.4
"""kv relative to sqrt(kp I): twice the damping ratio."""


class Drive:
    """Gains of a hand's joints and motors from a file, and proposals for missing ones."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        joints: dict[int, str],
        levers: dict[int, float],
    ):
        """Reads motors and couplings.

        Args:
          model: the model.
          data: its data in the file's pose.
          joints: names of the hand's joints.
          levers: distance of each from the farthest tip that it moves, m; a joint that moves none
            has those of its followers.
        """
        self.notes: list[str] = []
        self._model = model
        self._names = joints
        self._levers = dict.fromkeys(joints, MIN_LEVER) | levers
        self._inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, self._inertia)
        hand_servos = []
        driven: set[int] = set()
        for servo in servos(model, self.notes):
            hand_joints = servo.joints.keys() & joints.keys()
            if hand_joints:
                hand_servos.append(servo)
                driven |= hand_joints
        self.links = couplings(model, {*joints}, driven, self.notes)
        self._leaders = {link.a: link for link in self.links}
        for link in self.links:
            if link.b not in levers:
                lever = abs(link.ratio) * self._levers[link.a]
                self._levers[link.b] = max(self._levers[link.b], lever)
        self._limitless: list[str] = []
        self._strong: list[str] = []
        self._damped: list[str] = []
        if driven:
            passive = [
                name for j, name in joints.items() if j not in driven and j not in self._leaders
            ]
            self.notes += listed(
                "no motor in the file, one each is added ('couplings' in the hand file)", passive
            )
        self._pulls = self._assign(hand_servos)

    def couplings(self) -> tuple[Coupling, ...]:
        """Returns the couplings as data."""
        return tuple(
            Coupling(
                self._names[link.a],
                self._names[link.b],
                round(link.ratio, 6),
                round(link.offset, 6),
            )
            for link in self.links
        )

    def limits(self, j: int) -> np.ndarray | None:
        """Returns limits (2,) of a joint relative to the file's pose, or those by its leader's.

        None without any.
        """
        if self._model.jnt_limited[j]:
            return relative_limits(self._model, j)
        link = self._leaders.get(j)
        if link is None or not self._model.jnt_limited[link.b]:
            return None
        return np.sort(link.offset + link.ratio * relative_limits(self._model, link.b))

    def joint(self, j: int, lower: float, upper: float, joint: Joint) -> Joint:
        """Returns a joint with the gains of its motor, within the motor's range.

        The gains are zeros if it follows another joint, or a tendon moves it.

        Args:
          j: the joint's index in the model.
          lower: its lower limit relative to the file's pose, rad.
          upper: its upper limit, rad.
          joint: the joint without gains and limits.
        """
        dof = self._model.jnt_dofadr[j]
        damping = float(self._model.dof_damping[dof])
        kp = 0.0
        kv = 0.0
        limit = 0.0
        if self._has_motor(j):
            servo, scale = self._servo_of(j)
            kp, limit = self._gains(j, servo, scale, self._names[j])
            if servo is not None and j in servo.joints:
                lower, upper = self._within_reach(j, servo, lower, upper)
            moved = {j: 1.0}
            moved |= {link.a: link.ratio for link in self.links if link.b == j}
            kv = self._damping(moved, kp)
            if damping > _MAX_DAMPING_TIME * kp:
                self._damped.append(self._names[j])
                damping = _MAX_DAMPING_TIME * kp
        return dataclasses.replace(
            joint,
            lower=round(float(lower), 6),
            upper=round(float(upper), 6),
            kp=round(kp, 4),
            kv=round(kv, 4),
            torque_limit=round(limit, 4),
            damping=round(damping, 6),
            armature=float(self._model.dof_armature[dof]) or _DEFAULT_ARMATURE,
        )

    def tendons(self) -> tuple[Motor, ...]:
        """Returns motors of tendons, with coefficients of at most one."""
        motors = []
        for servo, pulled in self._pulls:
            if len(pulled) < 2:
                continue
            largest = max(map(abs, pulled.values()))
            longest = max(pulled, key=lambda j: self._levers[j])
            names = [self._names[j] for j in pulled]
            name = "_".join(["tendon", *names])
            kp, limit = self._gains(longest, servo, largest, name)
            relative = {j: coefficient / largest for j, coefficient in pulled.items()}
            coefficients = {self._names[j]: round(c, 6) for j, c in relative.items()}
            kv = self._damping(relative, kp)
            motors.append(Motor(name, coefficients, round(kp, 4), round(kv, 4), round(limit, 4)))
        return tuple(motors)

    def remarks(self) -> list[str]:
        """Returns the proposals, once all joints and tendons have been requested."""
        remarks = list(self.notes)
        remarks += listed(
            f"no torque limit, {FINGERTIP_FORCE:g} N at the fingertip is proposed ('torque_limit')",
            self._limitless,
        )
        remarks += listed(
            f"torque limits above {LARGEST_FORCE:g} N at the fingertip are lowered to that "
            f"('torque_limit')",
            self._strong,
        )
        remarks += listed(
            f"damping that holds joints for more than {_MAX_DAMPING_TIME:g} s is lowered "
            f"('damping' in the hand file)",
            self._damped,
        )
        return remarks

    def _assign(self, hand_servos: list[Servo]) -> list[tuple[Servo, dict[int, float]]]:
        """The joints that each servo pulls, by their coefficients; every joint has one servo."""
        pulls = [self._leading_joints(servo) for servo in hand_servos]
        shares = _one_servo_each(pulls)
        idle = sum(bool(before) and not after for before, after in zip(pulls, shares, strict=True))
        if idle:
            self.notes.append(
                f"{idle} motors that only pull joints of others are dropped ('tendons' in the hand "
                f"file)"
            )
        return list(zip(hand_servos, shares, strict=True))

    def _leading_joints(self, servo: Servo) -> dict[int, float]:
        """Joints pulled by a servo, with following joints replaced by their leaders."""
        pulled: dict[int, float] = {}
        for j, coefficient in servo.joints.items():
            link = self._leaders.get(j)
            if link:
                j = link.b
                coefficient *= link.ratio
            if j in self._names:
                pulled[j] = pulled.get(j, 0.0) + coefficient
        return {j: coefficient for j, coefficient in pulled.items() if coefficient}

    def _has_motor(self, j: int) -> bool:
        """True for a joint that follows none and is not moved by a tendon of several joints."""
        is_pulled = any(j in pulled for _, pulled in self._pulls if len(pulled) > 1)
        return j not in self._leaders and not is_pulled

    def _servo_of(self, j: int) -> tuple[Servo | None, float]:
        """The servo of a joint, and its coefficient; None without one.

        A servo of the joint itself precedes one of a follower.
        """
        candidates = [(servo, pulled[j]) for servo, pulled in self._pulls if pulled.keys() == {j}]
        for servo, coefficient in candidates:
            if j in servo.joints:
                return servo, coefficient
        if candidates:
            return candidates[0]
        return None, 1.0

    def _within_reach(
        self, j: int, servo: Servo, lower: float, upper: float
    ) -> tuple[float, float]:
        """Limits of a joint within the range of its servo's targets."""
        if not servo.reach:
            return lower, upper
        lower_reach = max(lower, servo.reach[0])
        upper_reach = min(upper, servo.reach[1])
        if lower_reach < upper_reach:
            return lower_reach, upper_reach
        self.notes.append(
            f"the control range of '{self._names[j]}' is outside its limits, and is left out"
        )
        return lower, upper

    def _gains(self, j: int, servo: Servo | None, scale: float, name: str) -> tuple[float, float]:
        """kp and torque limit of a motor, proposed if they are missing or implausible.

        Args:
          j: the joint that the motor turns, of a tendon the one with the longest lever.
          servo: the motor in the file, if any.
          scale: coefficient of the joint.
          name: name of the motor, for notes.
        """
        kp = 0.0
        limit = 0.0
        if servo:
            kp = servo.kp * scale**2
            limit = servo.limit * abs(scale)
        if self._model.jnt_actfrclimited[j]:
            joint_limit = float(np.abs(self._model.jnt_actfrcrange[j]).max())
            limit = min(filter(None, (limit, joint_limit)), default=0.0)
        lever = self._levers[j]
        if not limit:
            self._limitless.append(name)
            limit = FINGERTIP_FORCE * lever
        elif limit > LARGEST_FORCE * lever:
            self._strong.append(name)
            limit = LARGEST_FORCE * lever
        return kp or limit / _FULL_TORQUE_ERROR, limit

    def _damping(self, moved: dict[int, float], kp: float) -> float:
        """kv = 1.4 sqrt(kp I), with the inertia I of everything that a motor moves.

        Args:
          moved: ratio of each joint to the motor.
          kp: gain of the motor.
        """
        dofs = [self._model.jnt_dofadr[j] for j in moved]
        ratios = np.array([*moved.values()])
        inertia = self._inertia[np.ix_(dofs, dofs)].copy()
        armature = self._model.dof_armature[dofs]
        missing_armature = np.where(armature > 0, 0.0, _DEFAULT_ARMATURE)
        inertia[np.diag_indices(len(dofs))] += missing_armature
        total = max(ratios @ inertia @ ratios, _MIN_INERTIA)
        return float(_DAMPING_FACTOR * np.sqrt(kp * total))


def _one_servo_each(pulls: list[dict[int, float]]) -> list[dict[int, float]]:
    """Assigns every joint to one servo: one that pulls only this joint, or pulls it most.

    Args:
      pulls: coefficients of the joints that each servo pulls.
    """
    owner: dict[int, int] = {}
    for k, pull in enumerate(pulls):
        for j in pull:
            if j not in owner or _priority(pull, j) > _priority(pulls[owner[j]], j):
                owner[j] = k
    shares = []
    for k, pull in enumerate(pulls):
        if len(pull) == 1:
            shares.append(pull)
        else:
            shares.append({j: c for j, c in pull.items() if owner[j] == k})
    return shares


def _priority(pull: dict[int, float], j: int) -> tuple[bool, float]:
    """Priority of a servo for a joint."""
    return len(pull) == 1, abs(pull[j])
