"""A robot's control loop at 100 Hz that outlives its policy server; the robot is MuJoCo here.

    python examples/robot_loop.py --seconds 600 --kill-every 30

The policy answers over Zenoh from a separate process, which is killed (SIGKILL) and restarted every
`--kill-every` seconds. The robot receives a target every 10 ms throughout, within the limits of
position, speed and torque. At the end the loop prints how far joints, targets and torques were from
their limits, and the deadlines that it missed.
"""

import dataclasses
import json
import os
import pathlib
import subprocess
import sys
from typing import Literal

import mujoco
import numpy as np
import tyro

import congrasp
from congrasp.actors.physics.engine import physics_state
from congrasp.actors.physics.scene import TABLE_AWAY, addresses, compile_scene
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import scale_objects
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import policy_file
from congrasp.common.task.config import TaskConfig
from congrasp.common.transport.ports import local_url
from congrasp.services.serve.load import example_episode

BUFFER = 0.01
"""rad before the ends of the finger joints at which the robot's stops begin, which are springs in
MuJoCo.
"""
HOLD_STEPS = 200
"""Control steps without the table, after which a grasp is held or lost."""


@dataclasses.dataclass
class Arguments:
    """Options of the example."""

    seconds: float = 20.0
    """Duration of the loop, s."""
    kill_every: float = 0.0
    """Seconds from one kill of the server to the next; 0 leaves it alone."""
    hand: str = "allegro"
    """Hand whose pretrained policy is used."""
    policy: pathlib.Path | None = None
    """A policy file to use instead of the pretrained policy."""
    object_seed: int = 1_000_000
    """Seed of the procedural object and of the heading."""
    fallback: Literal["freeze", "open"] = "open"
    """Behaviour of a hand that holds nothing after half a second without a fresh answer."""


class MujocoRobot:
    """Hand, object and table in MuJoCo, driven by joint targets as a robot's servos are.

    Attributes:
      beyond: rad that a finger joint was farthest beyond its limits, in any physics step.
      fastest: greatest speed of a target as a share of its limit.
      strongest: greatest torque of a servo as a share of its limit.
    """

    def __init__(self, hand: Hand, task: TaskConfig, seed: int, limits: congrasp.JointLimits):
        self.request = example_episode(seed, hand.reference).request
        (obj,) = scale_objects(hand, task, [procedural.generate(seed)])
        self._hand, self._task, self._limits = hand, task, limits
        self.model = compile_scene(hand, task, obj)
        for joint in hand.joints:
            index = self.model.joint(joint.name).id
            self.model.jnt_margin[index] = BUFFER
            # As stiff as the time step allows
            self.model.jnt_solref[index] = (
                2.0 * self.model.opt.timestep,
                1.0,
            )
        strongest = np.roll(limits.torque, 6)  # in MuJoCo the wrist's servos come first
        self.model.actuator_forcerange[:] = np.stack([-strongest, strongest], 1)
        self.data = mujoco.MjData(self.model)
        self._where = addresses(self.model, hand)
        self._table = True
        self.beyond, self.fastest, self.strongest = -np.inf, 0.0, 0.0
        self.reset()

    def reset(self) -> None:
        """Puts hand, object and table to their poses at the start of the episode."""
        where, request, data = self._where, self.request, self.data
        mujoco.mj_resetData(self.model, data)
        self.model.body_pos[where.base_body], self.model.body_quat[where.base_body] = request.wrist
        data.qpos[where.finger_qpos] = request.q
        data.qpos[where.object_qpos] = np.concatenate(request.object_pose)
        self._target = np.append(request.q, np.zeros(6))
        self._table = True
        mujoco.mj_forward(self.model, data)

    def remove_table(self) -> None:
        """Takes the table away."""
        self.data.mocap_pos[self._where.table_mocap], self._table = TABLE_AWAY, False

    @property
    def height(self) -> float:
        """The object's height, m."""
        return float(self.data.xpos[self._where.object_body][2])

    def state(self) -> dict[str, np.ndarray]:
        """The state for `Policy.act`."""
        raw = (np.float32(x)[None] for x in (self.data.qpos, self.data.qvel, self.data.sensordata))
        found = physics_state(np, self._where, *raw, np.zeros(1, bool), np.zeros(2))._asdict()
        return {
            name: x[0] for name, x in found.items() if name not in ("diverged", "occupancy")
        } | {"table": np.asarray(self._table)}

    def move(self, command: congrasp.Command) -> None:
        """One control step towards the targets of a command."""
        target = np.append(command.q_target, command.u_target)
        moved = np.abs(target - self._target) / (self._limits.speed * self._task.control_dt)
        self.fastest, self._target = max(self.fastest, float(moved.max())), target
        self.data.ctrl[:] = np.append(command.u_target, command.q_target)
        for _ in range(self._task.substeps):
            mujoco.mj_step(self.model, self.data)
            q = self.data.qpos[self._where.finger_qpos]
            self.beyond = max(
                self.beyond, float(np.maximum(self._hand.lower - q, q - self._hand.upper).max())
            )
            force = np.abs(np.roll(self.data.actuator_force, -6)) / self._limits.torque
            self.strongest = max(self.strongest, float(force.max()))


class Server:
    """A policy server in a separate process."""

    def __init__(self, policy: pathlib.Path):
        """Starts it at a free port."""
        self.url = local_url()
        self._command = [sys.executable, "-m", "congrasp", "serve", "--policy", str(policy)]
        self.start()

    def start(self) -> None:
        """Starts it; it is ready some seconds later, and ends with this process."""
        environment = {**os.environ, "CONGRASP_PARENT": str(os.getpid())}
        self._process = subprocess.Popen(
            [*self._command, "--listen", self.url],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=environment,
        )

    @property
    def pid(self) -> int:
        """Number of its process."""
        return self._process.pid

    def kill(self) -> None:
        """Kills it (SIGKILL)."""
        self._process.kill()
        self._process.wait()


class Grasps:
    """Repeated grasps: approach, table away, hold; after a fallback a new one starts once the
    policy answers again.
    """

    def __init__(self, robot: MujocoRobot, guard: congrasp.Guard, task: TaskConfig):
        self._robot, self._guard, self._task = robot, guard, task
        self.outcomes = {"held": 0, "lost": 0, "given up": 0, "given up and dropped": 0}
        self._begin()

    def step(self) -> None:
        """One control step."""
        command = self._guard.step(self._robot.state())
        self._robot.move(command)
        self._followed += command.mode == "follow"
        if command.mode in ("freeze", "open"):
            if not self._guard.trouble:
                self._end("given up" if self._up() else "given up and dropped")
        elif self._followed == self._task.approach_steps and self._height is None:
            self._height = self._robot.height
            self._robot.remove_table()
        elif self._height is not None and self._followed >= self._task.approach_steps + HOLD_STEPS:
            self._end("held" if self._up() else "lost")

    def _up(self) -> bool:
        """True if the object has not dropped since the table was removed, or the table is still
        there.
        """
        return self._height is None or self._robot.height > self._height - self._task.drop_height

    def _begin(self) -> None:
        self._followed, self._height = 0, None
        self._robot.reset()
        self._guard.reset(self._robot.request, moved=True)

    def _end(self, outcome: str) -> None:
        self.outcomes[outcome] += 1
        self._begin()


def run(arguments: Arguments) -> dict[str, object]:
    """Runs the loop and returns its measurements."""
    policy = policy_file(arguments.policy, arguments.hand)
    task = bundles.load(policy).task
    hand = get_hand(task.hand)
    if len(hand.motors) != len(hand.joints):
        raise congrasp.CongraspError(
            f"Joints of the hand '{hand.name}' are coupled.",
            "Choose a hand with a motor for each joint.",
        )
    limits = congrasp.JointLimits.of_hand(hand, task.control)
    robot = MujocoRobot(hand, task, arguments.object_seed, limits)
    server, kills = Server(policy), 0
    try:
        client = congrasp.PolicyClient(server.url, hand=hand.name, timeout=0.2, wait=180.0)
        period = task.control_dt
        with congrasp.Guard(
            client, period=period, wait=0.6 * period, fallback=arguments.fallback
        ) as guard:
            grasps = Grasps(robot, guard, task)
            ticker = congrasp.Ticker(1.0 / period)
            begin = ticker.wait()
            while (now := ticker.wait() - begin) < arguments.seconds:
                grasps.step()
                if arguments.kill_every and now > arguments.kill_every * (kills + 1):
                    server.kill()
                    server.start()
                    kills += 1
    finally:
        server.kill()
    return {
        "kills": kills,
        "grasps": grasps.outcomes,
        "commands": dataclasses.asdict(guard.counters),
        "rate_hz": round(ticker.ticks / arguments.seconds, 2),
        "missed_deadlines": ticker.missed,
        "jitter_ms": {
            "p50": round(ticker.jitter_ms(50), 3),
            "p99": round(ticker.jitter_ms(99), 3),
            "max": round(ticker.longest_ms, 3),
        },
        "joint_beyond_its_limit_rad": round(robot.beyond, 5),
        "target_speed_of_its_limit": round(robot.fastest, 6),
        "torque_of_its_limit": round(robot.strongest, 6),
    }


def main() -> int:
    """Runs the loop and prints its measurements; the exit code is 1 if a joint left its limits."""
    result = run(tyro.cli(Arguments, description=__doc__))
    print(json.dumps(result, indent=1))
    return int(not float(str(result["joint_beyond_its_limit_rad"])) <= 0.0)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except congrasp.CongraspError as error:
        sys.exit(str(error))
