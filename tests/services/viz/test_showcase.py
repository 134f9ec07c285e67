"""The picture of one grasp under each constraint."""

import numpy as np
from PIL import Image

from congrasp.services.evaluate import showcase as module
from congrasp.services.evaluate.showcase import showcase
from tests.episodes import episode


def test_the_picture_has_a_row_for_each_constraint_and_counts_the_successes(monkeypatch, tmp_path):
    asked = []

    class Played:
        def __init__(self, policy, objects, **options):
            assert objects == ["an object"]

        def episode(self, constraint, attempts):
            asked.append(constraint)
            return episode(success=constraint != "pose")

    monkeypatch.setattr(module, "Evaluator", Played)
    monkeypatch.setattr(module, "load_pool", lambda config: ["an object"])
    monkeypatch.setattr(module, "_SIZE", (40, 30))
    told = []
    found = showcase(_policy(), tmp_path / "grasps.png", told.append)
    assert found == {"heading": True, "affordance": True, "pose": False, "fingers": True}
    assert asked == list(found) and len(told) == 4
    image = np.asarray(Image.open(tmp_path / "grasps.png"))
    assert image.shape[0] > 4 * 30 and image.shape[1] > 4 * 40


def _policy():
    import types

    task = types.SimpleNamespace(constraints=("heading", "affordance", "pose", "fingers"))
    return types.SimpleNamespace(version=3, task=task, spec=types.SimpleNamespace(hand_name="human"))
