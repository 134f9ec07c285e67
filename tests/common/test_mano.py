"""The MANO hand from a file of MANO's layout."""

import pickle

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import keypoints, link_transforms
from congrasp.common.hands.mano import MANO_FINGERS, VARIABLE, mano_axes, mano_hand, read_mano
from tests.mano_file import content, mano_pickle, skeleton


@pytest.fixture(scope="module")
def hand(mano):
    return mano_hand(read_mano(mano))


def _points(hand, **angles):
    """Keypoints by name: link origins and "<finger> tip"."""
    q = np.array([angles.get(joint.name, 0.0) for joint in hand.joints], np.float32)
    names = [link.name for link in hand.links] + [
        hand.links[i].name.partition("_")[0] + " tip" for i in hand.tip_links
    ]
    return dict(
        zip(names, np.asarray(keypoints(hand, link_transforms(hand, jnp.array(q)))), strict=True)
    )


def test_a_files_arrays_are_read_exactly(mano):
    model = read_mano(mano)
    expected = content()
    np.testing.assert_array_equal(model.vertices, expected["v_template"])
    np.testing.assert_array_equal(model.shape_directions, expected["shapedirs"])
    np.testing.assert_array_equal(model.regressor, expected["J_regressor"])
    np.testing.assert_array_equal(model.hand_mean, expected["hands_mean"])
    np.testing.assert_array_equal(model.components, expected["hands_components"])


_VARIANTS = {
    **{
        form: {"J_regressor": getattr(scipy.sparse, form)}
        for form in ("csr_matrix", "coo_matrix", "csc_array")
    },
    **{form: {"J_regressor": getattr(scipy.sparse, form)} for form in ("csr_array", "coo_array")},
    "lists": dict.fromkeys(
        ("v_template", "shapedirs", "J_regressor", "hands_mean"), np.ndarray.tolist
    ),
}


@pytest.mark.parametrize("variant", [*_VARIANTS, "bytes", "npz"])
def test_other_kinds_of_its_arrays_are_read_as_well(variant, tmp_path):
    values = {name: value for name, value in content().items() if isinstance(value, np.ndarray)}
    path = tmp_path / "hand.pkl"
    if variant == "npz":
        inside = np.array(scipy.sparse.csc_matrix(values["J_regressor"]), object)
        np.savez(tmp_path / "hand.npz", **values | {"J_regressor": inside})
        path = tmp_path / "hand.npz"
    elif variant == "bytes":
        path.write_bytes(pickle.dumps({name.encode(): value for name, value in values.items()}))
    else:
        changed = {name: change(values[name]) for name, change in _VARIANTS[variant].items()}
        path.write_bytes(pickle.dumps(values | changed))
    model = read_mano(path)
    np.testing.assert_array_equal(model.regressor, content()["J_regressor"])
    np.testing.assert_array_equal(model.shape_directions, content()["shapedirs"])


def test_a_variant_that_cannot_be_read_is_named_with_its_conversion(tmp_path):
    values = content() | {"J_regressor": scipy.sparse.lil_matrix(content()["J_regressor"])}
    (tmp_path / "hand.pkl").write_bytes(pickle.dumps(values))
    with pytest.raises(
        CongraspError, match=r"names 'scipy\.sparse\._lil\.lil_matrix'.*python -c .*hand\.npz"
    ):
        read_mano(tmp_path / "hand.pkl")


def test_the_skeleton_is_that_of_the_file_about_the_wrist(hand):
    joints, tips = skeleton()
    assert len(hand.joints) == 20
    assert len(hand.tip_links) == 5
    points = _points(hand)
    for i, finger in enumerate(MANO_FINGERS):
        names = (
            ("metacarpal", "proximal", "distal")
            if finger == "thumb"
            else ("proximal", "middle", "distal")
        )
        for k, name in enumerate(names):
            np.testing.assert_allclose(
                points[f"{finger}_{name}"], joints[1 + 3 * i + k] - joints[0], atol=1e-6
            )
        # The fingertip is skin: one radius beyond the end of the capsule's axis.
        radius = next(
            link.capsules[0].radius for link in hand.links if link.name == f"{finger}_distal"
        )
        gap = np.linalg.norm(points[f"{finger} tip"] - (tips[i] - joints[0]))
        assert gap == pytest.approx(radius, abs=1e-6)


def test_shape_parameters_move_the_skeleton(mano):
    model = read_mano(mano)
    betas = np.array([1.0, -2.0, 0.5])
    vertices = model.vertices + np.einsum("vcs,s->vc", model.shape_directions[..., :3], betas)
    joints = model.regressor @ vertices
    np.testing.assert_allclose(model.skeleton(betas)[0], joints, atol=1e-12)


def test_axes_are_anatomical():
    joints, tips = skeleton()
    axes = mano_axes(joints, tips)
    np.testing.assert_allclose(
        axes @ axes.swapaxes(-1, -2), np.broadcast_to(np.eye(3), (15, 3, 3)), atol=1e-12
    )
    assert (np.linalg.det(axes) > 0).all()
    child = np.concatenate([joints[1:].reshape(5, 3, 3)[:, 1:], tips[:, None]], 1).reshape(15, 3)
    bones = child - joints[1:]
    np.testing.assert_allclose(np.sum(axes[:, 0] * bones, -1), -np.linalg.norm(bones, axis=-1))


def test_positive_angles_flex_towards_the_palm_and_spread_towards_the_thumb(hand):
    flat = _points(hand)
    for finger in ("index", "middle", "ring", "little"):
        for joint in ("mcp_flexion", "pip", "dip"):
            bent = _points(hand, **{f"{finger}_{joint}": 0.6})
            assert (bent[f"{finger} tip"] - flat[f"{finger} tip"])[1] < -0.004, f"{finger}_{joint}"
        spread = _points(hand, **{f"{finger}_mcp_abduction": 0.3})
        assert (spread[f"{finger} tip"] - flat[f"{finger} tip"])[2] > 0.01
    for joint in ("cmc_flexion", "mp_flexion", "ip_flexion"):  # the thumb closes across the palm
        bent = _points(hand, **{f"thumb_{joint}": 0.6})
        away = np.linalg.norm(flat["thumb tip"] - flat["ring_proximal"])
        assert np.linalg.norm(bent["thumb tip"] - flat["ring_proximal"]) < away, joint


def test_it_is_found_by_name_only_where_the_users_file_is(mano, monkeypatch):
    get_hand.cache_clear()
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(CongraspError, match=rf"requires the file MANO_RIGHT.pkl.*{VARIABLE}="):
        get_hand("mano")
    monkeypatch.setenv(VARIABLE, str(mano))
    assert get_hand("mano") is get_hand("mano")
    get_hand.cache_clear()


def test_wrong_files_are_one_line(tmp_path):
    path = tmp_path / "MANO.pkl"
    with pytest.raises(CongraspError, match="cannot be read"):
        read_mano(path)
    left = content()
    left["v_template"] = left["v_template"] * [-1.0, 1.0, 1.0]
    wrong = {
        "left hand": left,
        "'J_regressor'": {name: x for name, x in content().items() if name != "J_regressor"},
        r"'hands_mean' \(45,\)": content() | {"hands_mean": np.zeros(44)},
        r"'v_template' \(778, 3\)": content() | {"v_template": np.full((778, 3), np.nan)},
    }
    for word, values in wrong.items():
        path.write_bytes(mano_pickle(values))
        with pytest.raises(CongraspError, match=word):
            read_mano(path)
