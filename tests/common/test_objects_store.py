"""Objects on disk come back as they were, or with one line that says why not."""

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.objects.procedural import generate
from congrasp.common.objects.store import Catalogue, digest, load, save


@pytest.mark.parametrize("family", ["mug", "bowl"])
def test_an_object_comes_back_as_it_was(tmp_path, family):
    obj = generate(1, family)
    save(obj, tmp_path / "x.safetensors")
    back = load(tmp_path / "x.safetensors")
    assert digest(back) == digest(obj)
    assert (back.name, back.family, back.part_names, back.mass) == (obj.name, obj.family, obj.part_names, obj.mass)
    for name in ("graspable", "inertia", "points", "normals", "labels", "rest_poses", "visual_faces"):
        np.testing.assert_array_equal(getattr(back, name), getattr(obj, name))
        assert getattr(back, name).dtype == getattr(obj, name).dtype
    for a, b in zip(back.pieces, obj.pieces, strict=True):
        assert (a.kind, a.size, a.part) == (b.kind, b.size, b.part)
        np.testing.assert_array_equal(a.pos, b.pos)
        np.testing.assert_array_equal(a.quat, b.quat)
        np.testing.assert_array_equal(a.vertices, b.vertices)


def test_a_catalogue_lists_what_was_added(tmp_path):
    catalogue = Catalogue(tmp_path / "new")
    with pytest.raises(CongraspError, match="no folder"):
        catalogue.list()
    for family in ("mug", "box"):
        catalogue.add(generate(2, family))
    assert catalogue.list() == ["box_2", "mug_2"]
    assert digest(catalogue.get("mug_2")) == digest(generate(2, "mug"))
    assert sorted(path.name for path in catalogue.folder.iterdir()) == ["box_2.safetensors", "mug_2.safetensors"]
    with pytest.raises(CongraspError, match="no object file"):
        catalogue.get("cup_2")
    with pytest.raises(CongraspError, match="cannot name an object"):
        catalogue.get("../mug_2")
