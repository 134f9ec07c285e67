"""What helps is free, what does not costs tokens by its size, and time brings them back."""

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import Message
from congrasp.learner.hub.limits import RateLimit
from tests.waits import Clock

A = "congrasp/r/rollout/0.a"
B = "congrasp/r/rollout/1.b"


def test_useless_requests_empty_a_certificates_bucket_and_time_fills_it():
    clock = Clock()
    limit = RateLimit(per_second=2.0, most=5.0, unit=100, clock=clock)
    for name in ("0.a", "0.b", "0.c"):
        assert limit.admits(f"congrasp/r/rollout/{name}")
        # Two each: one for itself, one for its size
        limit.charge(f"congrasp/r/rollout/{name}", 100)
    assert not limit.admits(A)
    assert not limit.admits("congrasp/r/ticket/0.z")
    assert limit.admits(B)
    assert limit.rejected == 2
    clock.now = 0.5  # -1 + 1: still nothing
    assert not limit.admits(A)
    clock.now = 0.6
    assert limit.admits(A)
    clock.now = 1e6
    for _ in range(5):
        assert limit.admits(A)
        limit.charge(A, 0)
    assert not limit.admits(A)  # no more than `most` is saved up


@pytest.mark.parametrize(
    ("meta", "cost"),
    [
        ({"outcome": "accepted"}, 0),
        ({"granted": True}, 0),
        ({"granted": False}, 4),
        ({"outcome": "duplicate"}, 4),
        ({"outcome": "refused"}, 4),
        ({}, 4),
        (None, 4),
    ],
)
def test_only_granted_or_accepted_requests_are_free(meta, cost):
    limit = RateLimit(per_second=0.0, most=100.0, unit=10, clock=Clock())

    def handler(key, request):
        if meta is None:
            raise CongraspError("bad")
        return Message(meta=meta)

    request = Message({"x": np.zeros(30, np.uint8)})
    for _ in range(25):
        if meta is None:
            with pytest.raises(CongraspError, match="bad"):
                limit.wrap_handler(handler)(A, request)
        else:
            assert limit.wrap_handler(handler)(A, request).meta == meta
    assert limit.admits(A) == (cost == 0)
    assert limit.admits(B)
