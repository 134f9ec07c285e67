"""A user's program, which `mypy --strict` accepts with the installed package alone."""

import pathlib
from typing import assert_type

import numpy as np

import congrasp


def closed(policy: congrasp.Policy, state: dict[str, np.ndarray]) -> np.ndarray:
    """Joint targets of a policy of either kind, (F,) rad."""
    answer = assert_type(policy.act(state), congrasp.Answer)
    return answer.q_target


def query(endpoint: str, points: np.ndarray) -> np.ndarray:
    """Joint targets of a server for a ball, (F,) rad."""
    rest = ((0.0, 0.0, 0.04), (1.0, 0.0, 0.0, 0.0))
    with congrasp.PolicyClient(endpoint, wait=60.0) as policy:
        opened = np.array(policy.metadata()["open_pose"])
        request = congrasp.GraspRequest(
            {"heading": {"position": np.zeros(3), "direction": (0, 0, -1)}},
            surface=points,
            q=opened,
            wrist=((0.0, 0.0, 0.2), (0.0, 0.7071, 0.7071, 0.0)),
            object_pose=rest,
        )
        policy.reset(request)
        state = {
            "q": opened,
            "u": np.zeros(6),
            "object_position": np.array(rest[0]),
            "object_quaternion": np.array(rest[1]),
        }
        return closed(policy, state)


def local(state: dict[str, np.ndarray]) -> np.ndarray:
    """Joint targets of a policy in this process, (F,) rad."""
    with congrasp.load_policy("allegro") as policy:
        return closed(policy, state)


def limited(policy: congrasp.Policy, request: congrasp.GraspRequest) -> str:
    """Mode of the first command of a guard."""
    with congrasp.Guard(policy, hold=1.0) as guard:
        guard.reset(request)
        command = assert_type(guard.step({"q": np.zeros(16)}), congrasp.Command)
        return command.mode


def grasp(mesh: pathlib.Path, out: pathlib.Path) -> congrasp.Episode:
    """Motion of a grasp from above, also written into a file."""
    try:
        result = assert_type(congrasp.grasp(mesh, heading="above", attempts=8), congrasp.Grasp)
    except congrasp.CongraspError as error:
        raise SystemExit(str(error)) from None
    congrasp.save_motion(out, result.motion)
    return assert_type(congrasp.load_motion(out), congrasp.Episode)


print(congrasp.__version__)
