"""Policies for left hands: those of the right ones, with mirrored states and targets; needs only
NumPy.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from congrasp.common import mirror
from congrasp.common.request import GraspRequest, Pose
from congrasp.services.client.fields import position_and_quaternion
from congrasp.services.client.policy import Answer, Policy, State


class LeftPolicy(Policy):
    """A `Policy` for the left hand, whose states and targets are mirrored for a policy of the right
    one.
    """

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
        return _mirrored_answer(self._right.act(mirror.fields(state)))

    def act_each(self, states: Sequence[State]) -> list[Answer]:
        """See `Policy.act_each`."""
        mirrored = [mirror.fields(state) for state in states]
        return [_mirrored_answer(answer) for answer in self._right.act_each(mirrored)]

    def metadata(self) -> dict[str, Any]:
        """See `Policy.metadata`; the limits are those of the left hand."""
        metadata = self._right.metadata()
        hand = f"{metadata['hand']}:left"
        return {**metadata, "hand": hand, "limits": _mirrored_limits(metadata["limits"])}

    def close(self) -> None:
        """See `Policy.close`."""
        self._right.close()


def _mirrored_limits(right: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Returns the limits of the left hand (`JointLimits.as_lists`), if there are any."""
    if right is None:
        return None
    # Where the mirror changes the sign, it exchanges the lower and the upper limit.
    ends = np.array([mirror.wrist(right["lower"]), mirror.wrist(right["upper"])])
    palm = [[-x, *rest] for x, *rest in right["palm"]]
    return {**right, "lower": ends.min(0).tolist(), "upper": ends.max(0).tolist(), "palm": palm}


def mirrored_request(request: GraspRequest) -> GraspRequest:
    """Returns the request for the mirror image of its object and hand."""
    return dataclasses.replace(
        request,
        constraints={name: mirror.fields(arrays) for name, arrays in request.constraints.items()},
        surface=_mirrored_vectors(request.surface),
        cloud=_mirrored_vectors(request.cloud),
        normals=_mirrored_vectors(request.normals),
        camera=_mirrored_vectors(request.camera),
        wrist=_mirrored_pose("wrist", request.wrist),
        object_pose=_mirrored_pose("object_pose", request.object_pose),
    )


def _mirrored_vectors(array: ArrayLike | None) -> np.ndarray | None:
    """Returns mirrored points or directions (..., 3), if there are any."""
    if array is None:
        return None
    return mirror.vector(array)


def _mirrored_answer(answer: Answer) -> Answer:
    """Returns the mirrored answer; the fingers have the same angles."""
    return answer._replace(
        u_target=mirror.wrist(answer.u_target), action=mirror.wrist(answer.action)
    )


def _mirrored_pose(name: str, pose: Pose | None) -> Pose | None:
    """Returns the mirrored pose in the request's field `name`, if there is one."""
    if pose is None:
        return None
    position, quaternion = position_and_quaternion(name, pose)
    return mirror.vector(position), mirror.quaternion(quaternion)
