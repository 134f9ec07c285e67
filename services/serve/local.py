"""Policy in this process: the answers of a server without a server."""

import os
import time
from typing import Any

from congrasp.common.errors import CongraspError, error_of
from congrasp.common.hands import get_hand
from congrasp.common.hands.left import right_name
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.policy.pretrained import named_policy
from congrasp.common.wire.codec import Message
from congrasp.services.client.episode import EpisodePolicy
from congrasp.services.client.left import LeftPolicy
from congrasp.services.client.policy import Policy
from congrasp.services.serve.inference import BATCH_SIZES, PolicyFunction


class LocalPolicy(EpisodePolicy):
    """The `Policy` of a bundle."""

    def __init__(self, bundle: PolicyBundle):
        """Compiles `act`, so that no control step waits for it; `act_each` is compiled at its first call.

        Args:
          bundle: the policy, which determines the hand.
        """
        super().__init__()
        self._bundle = bundle
        self._function = PolicyFunction(get_hand(bundle.spec.hand), bundle.task)
        self._function.warm_up(bundle.inference_parameters, BATCH_SIZES[:1])

    def _described(self) -> dict[str, Any]:
        """The metadata of the bundle."""
        return self._function.metadata()

    def _query(self, query: Message) -> Message:
        """Returns the reply of a server with this bundle."""
        began = time.perf_counter()
        try:
            parsed = self._function.layout.parse(query)
            (answer,) = self._function(self._bundle.inference_parameters, [parsed])
            if isinstance(answer, Exception):
                raise answer
        except CongraspError as error:
            raise error_of(error.code, str(error)) from None
        return answer.reply({"version": self._bundle.version, "total_ms": 1e3 * (time.perf_counter() - began)})


def load_policy(policy: str | os.PathLike[str] = "human") -> Policy:
    """Loads the policy of a file, or the pretrained one of a hand, in this process.

    Args:
      policy: a policy file (`policy.safetensors` in a run's folder), or the name of a hand (`human:left` for the left).

    Raises:
      CongraspError: there is no such file or hand, or the file is damaged.
    """
    right, left = right_name(str(policy))
    found = LocalPolicy(bundles.load(named_policy(right)))
    return LeftPolicy(found) if left else found
