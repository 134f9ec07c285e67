"""Credit: what helps is free, what does not costs by its size, and time brings it back."""

import numpy as np
import pytest

from common.errors import CongraspError
from common.wire.codec import Message
from learner.limits import Credit

A, B = "congrasp/r/rollout/0.a", "congrasp/r/rollout/1.b"


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def test_useless_requests_use_credit_up_by_certificate_and_time_returns_it():
    clock = Clock()
    credit = Credit(per_second=2.0, most=5.0, unit=100, clock=clock)
    for name in ("0.a", "0.b", "0.c"):
        assert credit.admits(f"congrasp/r/rollout/{name}")
        credit.charge(f"congrasp/r/rollout/{name}", 100)  # two each: one for itself, one for its size
    assert not credit.admits(A) and not credit.admits("congrasp/r/ticket/0.z") and credit.admits(B)
    assert credit.turned_away == 2
    clock.now = 0.5  # -1 + 1: still nothing
    assert not credit.admits(A)
    clock.now = 0.6
    assert credit.admits(A)
    clock.now = 1e6
    for _ in range(5):
        assert credit.admits(A)
        credit.charge(A, 0)
    assert not credit.admits(A)  # no more than `most` is saved up


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
def test_only_what_is_granted_or_accepted_is_free(meta, cost):
    credit = Credit(per_second=0.0, most=100.0, unit=10, clock=Clock())

    def handler(key, request):
        if meta is None:
            raise CongraspError("bad")
        return Message(meta=meta)

    request = Message({"x": np.zeros(30, np.uint8)})
    for _ in range(25):
        if meta is None:
            with pytest.raises(CongraspError, match="bad"):
                credit.charging(handler)(A, request)
        else:
            assert credit.charging(handler)(A, request).meta == meta
    assert credit.admits(A) == (cost == 0)
    assert credit.admits(B)
