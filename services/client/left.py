"""The policy of a right hand, for the left one; needs only NumPy."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from congrasp.common import mirror
from congrasp.common.request import GraspRequest, Pose
from congrasp.services.client.policy import Answer, Policy, State


class LeftPolicy(Policy):
    """A `Policy` for the left hand, whose states and targets are mirrored for a policy of the right one."""

    def __init__(self, right: Policy):
        """Wraps a policy, and takes over its connection.

        Args:
          right: the policy, in this process or of a server.
        """
        self._right = right

    def reset(self, request: GraspRequest) -> None:
        """See `Policy.reset`."""
        self._right.reset(mirrored_request(request))

    def act(self, state: State) -> Answer:
        """See `Policy.act`."""
        return _answer(self._right.act(mirror.fields(state)))

    def act_each(self, states: Sequence[State]) -> list[Answer]:
        """See `Policy.act_each`."""
        return [_answer(answer) for answer in self._right.act_each([mirror.fields(state) for state in states])]

    def metadata(self) -> dict[str, Any]:
        """See `Policy.metadata`; the limits are those of the left hand."""
        found = self._right.metadata()
        limits = found["limits"] and dict(found["limits"])
        if limits:
            ends = np.array([mirror.wrist(limits[name]) for name in ("lower", "upper")])
            limits["lower"], limits["upper"] = ends.min(0).tolist(), ends.max(0).tolist()
            limits["palm"] = [[-x, *rest] for x, *rest in limits["palm"]]
        return {**found, "hand": f"{found['hand']}:left", "limits": limits}

    def close(self) -> None:
        """See `Policy.close`."""
        self._right.close()


def mirrored_request(request: GraspRequest) -> GraspRequest:
    """The request for the mirror image of its object and hand."""
    return dataclasses.replace(
        request,
        constraints={name: mirror.fields(own) for name, own in request.constraints.items()},
        surface=_vectors(request.surface),
        cloud=_vectors(request.cloud),
        normals=_vectors(request.normals),
        camera=_vectors(request.camera),
        wrist=request.wrist and _pose(request.wrist),
        object_pose=request.object_pose and _pose(request.object_pose),
    )


def _vectors(array: np.ndarray | None) -> np.ndarray | None:
    """Mirrored points or directions, if there are any."""
    return None if array is None else mirror.vector(array)


def _answer(answer: Answer) -> Answer:
    """The mirrored answer."""
    return answer._replace(u_target=mirror.wrist(answer.u_target), action=mirror.wrist(answer.action))


def _pose(pose: Pose) -> Pose:
    """A mirrored pose."""
    position, quaternion = pose
    return mirror.vector(position), mirror.quaternion(quaternion)
