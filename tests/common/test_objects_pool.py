"""Which objects an actor or an evaluation works with."""

import hypothesis.strategies as st
import pytest
from hypothesis import given

from congrasp.common.config import ObjectsConfig
from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import HELD_OUT_SEED, first_seed, load_pool
from congrasp.common.objects.store import Catalogue


def test_actors_have_objects_of_their_own():
    config = ObjectsConfig(count=2, seed=3, families=("box",))
    pools = [[obj.name for obj in load_pool(config, shift)] for shift in (0, 1)]
    assert pools == [["box_3", "box_4"], ["box_5", "box_6"]]


@given(st.integers(0, HELD_OUT_SEED - 1), st.integers(1, 5000), st.integers(0, 2**32 - 1))
def test_training_never_touches_the_objects_of_evaluation(seed, count, shift):
    first = first_seed(ObjectsConfig(seed=seed, count=count), shift)
    assert first >= 0 and first + count <= HELD_OUT_SEED


@given(st.integers(0, HELD_OUT_SEED - 1), st.integers(1, 5000), st.integers(0, 2**32), st.integers(0, 2**32))
def test_actors_share_no_object_while_there_are_enough(seed, count, one, other):
    actors = (HELD_OUT_SEED - seed % count) // count
    firsts = [first_seed(ObjectsConfig(seed=seed, count=count), shift % actors) for shift in (one, other)]
    assert one % actors == other % actors or abs(firsts[0] - firsts[1]) >= count


def test_evaluation_has_the_same_objects_everywhere():
    config = ObjectsConfig(count=2, seed=HELD_OUT_SEED + 7)
    assert first_seed(config, 0) == first_seed(config, 123) == HELD_OUT_SEED + 7


def test_a_folder_gives_all_its_objects_whoever_asks(tmp_path):
    catalogue = Catalogue(tmp_path)
    for seed in (2, 1):
        catalogue.add(procedural.generate(seed, "box"))
    config = ObjectsConfig(folder=str(tmp_path), count=1)
    for shift in (0, 5):
        assert [obj.name for obj in load_pool(config, shift)] == ["box_1", "box_2"]


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (ObjectsConfig(count=0), "pool is empty: objects.count is 0"),
        (ObjectsConfig(folder="/nonexistent"), "no folder /nonexistent"),
        (ObjectsConfig(count=1, families=("unicorn",)), "unicorn"),
    ],
)
def test_pools_that_cannot_be_are_refused_in_words(config, words):
    with pytest.raises(CongraspError, match=words):
        load_pool(config)


def test_an_empty_folder_says_how_to_fill_it(tmp_path):
    with pytest.raises(CongraspError, match=r"holds no object\. .*objects import"):
        load_pool(ObjectsConfig(folder=str(tmp_path)))
