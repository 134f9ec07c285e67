"""Written fields of the task's configuration, against the tables that they repeat."""

import dataclasses

import docstring_parser
import pytest

from congrasp.common.task.config import ConstraintProbabilities, RewardWeights
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.reward import GRASP


def settings_of(kind: type) -> list[tuple[str, float, str]]:
    """Name, default and help of the fields of a dataclass, in order."""
    help_of = {
        field.arg_name: " ".join((field.description or "").split())
        for field in docstring_parser.parse_from_object(kind).params
    }
    return [(field.name, field.default, help_of[field.name]) for field in dataclasses.fields(kind)]


def test_weights_repeat_the_reward_terms():
    terms = [(term.name, term.default, term.meaning) for term in GRASP]
    for constraint in CONSTRAINTS:
        terms += [tuple(weight) for weight in constraint.weights]
    assert settings_of(RewardWeights) == terms


def test_probabilities_repeat_the_constraints():
    rows = [
        (
            f"p_{constraint.name}",
            0.5,
            f"Probability that an episode has the constraint '{constraint.name}', where the object "
            f"allows it.",
        )
        for constraint in CONSTRAINTS
        if constraint.optional
    ]
    assert settings_of(ConstraintProbabilities) == rows


@pytest.mark.parametrize("kind", [RewardWeights, ConstraintProbabilities])
def test_fields_are_written_in_the_class(kind):
    assert set(kind.__annotations__.values()) == {float}  # outside ones are annotated with Doc
