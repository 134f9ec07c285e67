"""Files with fewer motors than joints, on arms and in scenes, left and right, of hands of our own
making.
"""

import pathlib

import mujoco
import numpy as np
import pytest
import trimesh

from congrasp.actors.physics import make_physics
from congrasp.common.errors import CongraspError
from congrasp.common.hands import VARIABLE, get_hand
from congrasp.common.hands.files import hand_from_text, hand_text
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.meshes import MAX_FACES, load_meshes, save_meshes
from congrasp.common.hands.mjcf import add_hand
from congrasp.common.hands.skin import skin_of_meshes
from congrasp.common.hands.spec import chain_of
from congrasp.common.task.config import TaskConfig
from congrasp.services.assets.hands.model_files import Choices, propose
from congrasp.services.assets.hands.summary import describe
from congrasp.services.cli import main
from congrasp.services.viz.hand_sheets import hands_sheet

HANDS = pathlib.Path(__file__).parents[3] / "hands"


@pytest.fixture(scope="module")
def driven():
    return propose(HANDS / "driven.xml")


def _mirrored(path, out):
    """A file with the mirror image, at y = 0, of an MJCF hand whose bodies are not turned."""
    spec = mujoco.MjSpec.from_file(str(path))
    for body in spec.bodies:
        body.pos = body.pos * [1, -1, 1]
    for joint in spec.joints:
        joint.axis = joint.axis * [-1, 1, -1]
    for geom in spec.geoms:
        geom.pos, geom.fromto = geom.pos * [1, -1, 1], geom.fromto * [1, -1, 1, 1, -1, 1]
    spec.compile()
    out.write_text(spec.to_xml())
    return out


def test_one_motor_moves_a_gripper_of_two_fingers():
    proposal = propose(HANDS / "pincher.urdf")
    hand = proposal.hand
    assert len(hand.joints) == 4
    assert len(hand.motors) == 1
    assert len(hand.tip_links) == 2
    assert proposal.palm == "housing"
    follow = {x.joint: (x.leader, x.ratio, x.offset) for x in hand.couplings}
    assert follow == {  # that of the last joint through the one that it mimics
        "left_parallel": ("left", -1.0, 0.0),
        "right": ("left", 1.0, 0.0),
        "right_parallel": ("left", 1.0, 0.0),
    }
    assert hand.closed_pose["left"] > 0.5 > 0.0 > hand.open_pose["left"]
    assert hand.motors[0].torque_limit == 2.0
    frame = grasp_frame(hand)
    np.testing.assert_allclose(frame.heading, (0.0, 0.0, 1.0), atol=0.1)
    assert abs(frame.cross[1]) > 0.99
    words = "\n".join(describe(proposal))
    assert "left_parallel          = 0.000 + -1.000 left" in words
    assert "capsules follow from inertias ('capsules' in the hand file): right_pad" in words


def test_palm_and_thumb_are_found_in_a_scene_without_names(driven):
    hand = driven.hand
    assert driven.palm == "base"
    assert hand.thumb == "side_end"
    chains = [chain_of(hand, hand.links[i].name) for i in hand.tip_links]
    assert [len(chain) for chain in chains] == [3, 3, 3, 3]
    assert not {"arm", "wrist", "door"} & {joint.name for joint in hand.joints}


def test_tendons_and_curves_become_couplings_and_motors(driven):
    hand = driven.hand
    assert len(hand.joints) == 16
    assert len(hand.motors) == 13
    (tendon,) = hand.tendons
    # Apart from links of those names
    assert tendon.joints == {
        "index_middle_joint": 1.0,
        "index_end_joint": 0.8,
    }
    # 30,000 N/m and 60 N at a radius of 0.01 m.
    assert (tendon.kp, tendon.torque_limit) == pytest.approx((3.0, 0.6))
    follow = {x.joint: x for x in hand.couplings}
    ring = follow["ring_end_joint"]
    middle = follow["middle_end_joint"]
    assert ring.leader == "ring_middle_joint"
    assert ring.ratio == pytest.approx(5 / 7, abs=1e-5)
    assert ring.offset == 0.0
    x = np.linspace(0.0, 1.57, 200)
    assert np.abs(middle.offset + middle.ratio * x - (0.5 * x + 0.1 * x**2)).max() < 0.05
    assert any("'middle_end' follows a curve" in note for note in driven.notes)
    assert hand_from_text(hand_text(hand)) is hand


def test_the_thumb_of_the_open_hand_is_turned_against_the_fingers(driven):
    hand = driven.hand
    assert hand.open_pose["side_turn"] > 1.2
    frame = grasp_frame(hand)
    # Objects lie on the side +x, between fingers and thumb
    assert frame.heading[0] > 0.9
    assert frame.cross[2] > 0.9
    closing = [
        name for name in hand.closed_pose if name.endswith(("root", "middle", "side_end_joint"))
    ]
    assert all(hand.closed_pose[name] > hand.open_pose.get(name, 0.0) for name in closing)


def test_a_left_hand_is_the_mirror_image(driven, tmp_path):
    left = propose(_mirrored(HANDS / "driven.xml", tmp_path / "left.xml")).hand
    right = driven.hand
    assert left.thumb == right.thumb
    assert len(left.motors) == 13
    np.testing.assert_allclose(left.q_open, right.q_open, atol=0.05)
    np.testing.assert_allclose(left.q_closed, right.q_closed, atol=0.1)
    ours = grasp_frame(left)
    theirs = grasp_frame(right)
    np.testing.assert_allclose(ours.heading, theirs.heading * [1, -1, 1], atol=0.05)
    np.testing.assert_allclose(ours.center, theirs.center * [1, -1, 1], atol=0.005)


def test_visual_meshes_of_a_file_are_stored_and_drawn(driven, tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    get_hand.cache_clear()
    path = tmp_path / "driven.json"
    path.write_text(hand_text(driven.hand))
    save_meshes(path, driven.meshes)
    loaded = load_meshes(path, driven.hand)
    assert loaded.keys() == {link.name for link in driven.hand.links}
    vertices, faces = loaded["palm"]  # the box of the file, in the palm's frame
    np.testing.assert_allclose(
        [vertices.min(0), vertices.max(0)], [[-0.012, -0.04, -0.005], [0.012, 0.04, 0.085]]
    )
    assert len(faces) == 12
    skin = skin_of_meshes(
        driven.hand, {"palm": loaded["palm"]}
    )  # of the other links their capsules
    assert np.abs(skin.points[:8] - vertices).max() == 0
    assert len(skin.weights.T) == len(driven.hand.links)
    drawn, capsules = (hands_sheet([driven.hand], [x], size=(40, 40)) for x in (skin, None))
    assert np.abs(drawn.astype(int) - capsules).max() > 30
    assert main.run(["hands", "sheet", "driven", "--out", str(tmp_path / "sheet.png")]) == 0

    def refused(word, meshes):
        save_meshes(path, meshes)
        with pytest.raises(CongraspError, match=word) as raised:
            load_meshes(path, driven.hand)
        assert "\n" not in str(raised.value)

    refused("contains no mesh of 'palm'", {"palm": (vertices, faces + len(vertices))})
    # A point of no face has no normal of its own: any will do, but none of no length.
    loose = skin_of_meshes(driven.hand, {"palm": (np.vstack([vertices, [[1.0, 0.0, 0.0]]]), faces)})
    still = loose.posed(loose.origins, np.broadcast_to(np.eye(3), (len(loose.origins), 3, 3)))
    np.testing.assert_allclose(np.linalg.norm(still[1], axis=1), 1.0, rtol=1e-5)
    refused("has no link 'wing'", {"wing": (vertices, faces)})
    refused("has 'palm' 85 m from the wrist, more than 2 m", {"palm": (1000 * vertices, faces)})
    save_meshes(path, {})
    assert load_meshes(path, driven.hand) == {}


def test_a_hand_can_collide_by_the_shapes_of_its_file(driven):
    """Every geom of the file that collides is in the hand's model, where it is in the file, and the
    masses stay.
    """
    hand = propose(HANDS / "driven.xml", Choices(own_collision=True)).hand
    assert hand_from_text(hand_text(hand)) is hand
    assert all(link.solids for link in hand.links)
    theirs = mujoco.MjModel.from_xml_path(str(HANDS / "driven.xml"))
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_hand(spec, hand, self_collision=True)
    ours = spec.compile()

    def shapes(model, palm, bodies):
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        root = data.body(palm).xpos
        turn = data.body(palm).xmat.reshape(3, 3)
        geoms = [
            g
            for g in range(model.ngeom)
            if bodies(g) and model.geom_contype[g] | model.geom_conaffinity[g]
        ]
        rows = [(*model.geom_size[g], *((data.geom_xpos[g] - root) @ turn)) for g in geoms]
        return np.array(sorted(rows)), sorted(model.geom_type[geoms].tolist())

    part = {theirs.body("base").id}
    for body in range(theirs.nbody):
        part |= {body} if theirs.body_parentid[body] in part else set()
    expected = shapes(theirs, "base", lambda g: theirs.geom_bodyid[g] in part)
    actual = shapes(ours, "palm", lambda g: True)
    assert actual[1] == expected[1]
    assert {2, 3, 6} <= {*actual[1]}  # balls, capsules and boxes
    np.testing.assert_allclose(actual[0], expected[0], atol=2e-6)
    assert ours.body_mass.sum() == pytest.approx(sum(link.mass for link in driven.hand.links))
    with pytest.raises(CongraspError, match="jax supports capsules only"):
        make_physics("jax", hand, TaskConfig(), [], threads=1)


def test_links_that_collide_by_meshes_keep_their_capsules(tmp_path):
    trimesh.creation.icosphere(1, 0.009).export(tmp_path / "pad.stl")
    text = (HANDS / "claw.urdf").read_text()
    text = text.replace('<sphere radius="0.009"/>', '<mesh filename="package://x/pad.stl"/>')
    (tmp_path / "claw.urdf").write_text(text)
    proposal = propose(tmp_path / "claw.urdf", Choices(own_collision=True))
    (note,) = (note for note in proposal.notes if "capsules are used" in note)
    links = {link.name: link for link in proposal.hand.links}
    assert "left_upper" in note
    assert not links["left_upper"].solids
    assert links["left_upper"].capsules


def test_a_fine_mesh_is_simplified(tmp_path):
    trimesh.creation.icosphere(5, 0.009).export(tmp_path / "pad.stl")
    text = (
        (HANDS / "claw.urdf")
        .read_text()
        .replace('<sphere radius="0.009"/>', '<mesh filename="package://x/pad.stl"/>')
    )
    (tmp_path / "claw.urdf").write_text(text)
    proposal = propose(tmp_path / "claw.urdf")
    vertices, faces = proposal.meshes["left_upper"]
    assert 1000 < len(faces) <= MAX_FACES < 20_000
    # The pad's centre is 5 cm along the link, whose capsule is fitted to it as well.
    joints = {joint.name: joint for joint in proposal.hand.joints}
    reach = np.linalg.norm(vertices - np.array(joints["left_middle"].anchor), axis=-1).max()
    assert reach == pytest.approx(0.059, abs=1e-3)


@pytest.mark.parametrize("suffix", ["stl", "obj"])
def test_a_mesh_of_many_triangles_keeps_its_shape(suffix, tmp_path):
    """81,920 triangles, which are merged at their corners, also where a texture is cut, and reduced
    for MuJoCo.
    """
    ball = trimesh.creation.icosphere(6, 0.009)
    if suffix == "obj":
        ball.unmerge_vertices()
        cut = np.random.default_rng(0).random((len(ball.vertices), 2))
        ball.visual = trimesh.visual.TextureVisuals(uv=cut)
    ball.export(tmp_path / f"pad.{suffix}")
    text = (
        (HANDS / "claw.urdf")
        .read_text()
        .replace('<sphere radius="0.009"/>', f'<mesh filename="pad.{suffix}"/>')
    )
    (tmp_path / "claw.urdf").write_text(text)
    drawn = trimesh.Trimesh(*propose(tmp_path / "claw.urdf").meshes["left_upper"])
    pad = max(drawn.split(only_watertight=False), key=lambda body: len(body.faces))
    assert pad.volume == pytest.approx(4 / 3 * np.pi * 0.009**3, rel=0.03)
