"""Exported grasps are where DexGraspBench's own kinematics has them, press as the policy did, and
are examined.
"""

import dataclasses
import itertools
import json
import subprocess
import sys

import jax
import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.common.episode.hand_arrays import hand_arrays
from congrasp.common.episode.motion_file import save_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import keypoints, link_transforms
from congrasp.common.hands.mjcf import add_hand, mujoco_link_poses
from congrasp.common.hands.spec import Motor
from congrasp.common.task.config import TaskConfig
from congrasp.services.assets.hands import trials
from tests.benchmarks.dexgraspbench import dexgraspbench, write_grasp
from tests.benchmarks.dexgraspbench_grasps import (
    STATES,
    Grasp,
    State,
    benchmark_grasp,
    read_grasps,
    squeezed,
)
from tests.benchmarks.dexgraspbench_hands import BENCHMARK_HANDS, benchmarked, match_hand
from tests.benchmarks.dexgraspbench_replay import replayed
from tests.docs.test_docs import ROOT
from tests.episodes import episode
from tests.services.export.test_motion import posed

T = 6
HAND = get_hand("allegro")
PLAIN = (1, 0, 0, 0)
# The bodies of MuJoCo Menagerie's wonik_allegro/right_hand.xml and shadow_hand/right_hand.xml
# without the forearm, as the benchmark has them: name, place and quaternion in the parent's frame,
# and axis of the joint.
LEAN = 0.0436194
ALLEGRO = [
    [
        (f"{name}j0", base, (0.999048, lean, 0, 0), (0, 0, 1)),
        (f"{name}j1", (0, 0, 0.0164), PLAIN, (0, 1, 0)),
        (f"{name}j2", (0, 0, 0.054), PLAIN, (0, 1, 0)),
        (f"{name}j3", (0, 0, 0.0384), PLAIN, (0, 1, 0)),
    ]
    for name, base, lean in (
        ("ff", (0, 0.0435, -0.001542), -LEAN),
        ("mf", (0, 0, 0.0007), 0.0),
        ("rf", (0, -0.0435, -0.001542), LEAN),
    )
] + [
    [
        (
            "thj0",
            (-0.0182, 0.019333, -0.045987),
            (0.477714, -0.521334, -0.521334, -0.477714),
            (-1, 0, 0),
        ),
        ("thj1", (-0.027, 0.005, 0.0399), PLAIN, (0, 0, 1)),
        ("thj2", (0, 0, 0.0177), PLAIN, (0, 1, 0)),
        ("thj3", (0, 0, 0.0514), PLAIN, (0, 1, 0)),
    ]
]
# Its collision geoms in the bodies' frames: boxes (half extents, place), at the tips capsules
# (radius, half length).
PHALANX = [
    (0.0098, 0.01375, 0.0082),
    (0.0098, 0.01375, 0.027),
    (0.0098, 0.01375, 0.0192),
    (0.0098, 0.01375, 0.008),
]
BOXES = {
    f"{name}j{i}": (size, (0, 0, size[2]))
    for name, (i, size) in itertools.product(("ff", "mf", "rf"), enumerate(PHALANX))
} | {
    "thj0": ((0.0179, 0.017, 0.02275), (-0.0179, 0.009, 0.0145)),
    "thj1": ((0.0098, 0.01375, 0.00885), (0, 0, 0.00885)),
    "thj2": ((0.0098, 0.01375, 0.0257), (0, 0, 0.0257)),
    "thj3": ((0.0098, 0.01375, 0.0157), (0, 0, 0.0157)),
}
CAPSULES = {name: ((0.012, 0.01), (0, 0, 0.019)) for name in ("ffj3", "mfj3", "rfj3")}
CAPSULES["thj3"] = ((0.012, 0.008), (0, 0, 0.035))
ALLEGRO_TIPS = {"ffj3": 0.0267, "mfj3": 0.0267, "rfj3": 0.0267, "thj3": 0.0423}


def shadow_finger(name, base, side):
    return [
        (f"rh_{name}J4", base, PLAIN, (0, side, 0)),
        (f"rh_{name}J3", (0, 0, 0), PLAIN, (1, 0, 0)),
        (f"rh_{name}J2", (0, 0, 0.045), PLAIN, (1, 0, 0)),
        (f"rh_{name}J1", (0, 0, 0.025), PLAIN, (1, 0, 0)),
    ]


SHADOW = [
    shadow_finger("FF", (0.033, 0, 0.095), -1),
    shadow_finger("MF", (0.011, 0, 0.099), -1),
    shadow_finger("RF", (-0.011, 0, 0.095), 1),
    [
        ("rh_LFJ5", (-0.033, 0, 0.02071), PLAIN, (0.573576, 0, 0.819152)),
        *shadow_finger("LF", (0, 0, 0.06579), 1),
    ],
    [
        ("rh_THJ5", (0.034, -0.00858, 0.029), (0.92388, 0, 0.382683, 0), (0, 0, -1)),
        ("rh_THJ4", (0, 0, 0), PLAIN, (1, 0, 0)),
        ("rh_THJ3", (0, 0, 0.038), PLAIN, (1, 0, 0)),
        ("rh_THJ2", (0, 0, 0), PLAIN, (0, -1, 0)),
        ("rh_THJ1", (0, 0, 0.032), (1, 0, 0, -1), (1, 0, 0)),
    ],
]


def numbers(values):
    return " ".join(map(str, values))


def benchmark_model(fingers, palm, *, root=True):
    """Their hand on the root that the benchmark places: a free body that carries the palm."""
    free = "<freejoint/>" if root else ""
    xml = f"<mujoco><compiler angle='radian'/><worldbody><body name='root'>{free}<geom size='.01'/>"
    xml += f"<body name='palm' {palm}><geom size='.01'/>"
    for finger in fingers:
        for joint, place, quat, axis in finger:
            xml += f"<body name='{joint}' pos='{numbers(place)}' quat='{numbers(quat)}'>"
            xml += f"<joint name='{joint}' axis='{numbers(axis)}' range='-0.3 1.2'/>"
            for kind, shapes in (("box", BOXES), ("capsule", CAPSULES)):
                if joint in shapes:
                    size, middle = map(numbers, shapes[joint])
                    xml += f"<geom type='{kind}' size='{size}' pos='{middle}'/>"
            xml += "<geom size='.008'/>"
        xml += "</body>" * len(finger)
    return xml + "</body></body></worldbody></mujoco>"


def motion_of(hand, *, seed=0) -> Episode:
    """A wild motion of a hand beside a small ball: any wrist, any fingers, the object moves."""
    still = dataclasses.replace(episode(T).normalised(), hand=hand.name, **hand_arrays(hand))
    motion = posed(still, lambda q: mujoco_link_poses(hand, q), seed)
    wrist = Rotation.from_quat(motion.wrist_quaternion, scalar_first=True)
    ball = trimesh.creation.icosphere(2, 0.02)
    return dataclasses.replace(
        motion,
        metrics={"held": 1.0},
        joint_target=motion.joint_position,
        link_quaternion=np.tile([1.0, 0, 0, 0], (T, len(hand.links), 1)),
        link_force=np.zeros((T, len(hand.links), 3)),
        object_position=motion.wrist_position + wrist.apply([0.3, 0.0, 0.0]),
        object_vertices=np.asarray(ball.vertices, np.float32),
        object_faces=np.asarray(ball.faces, np.int32),
        goal={},
        object_file_origin=np.array([0.01, 0.02, 0.03]),
        object_file_scale=np.array(0.5),
    )


@pytest.fixture(scope="module")
def motion() -> Episode:
    return motion_of(HAND)


def test_allegros_fingertips_are_where_menageries_model_has_them(motion, tmp_path):
    write_grasp(benchmark_grasp("ball", motion), tmp_path)
    with np.load(tmp_path / "graspdata/ball/congrasp/0.npz", allow_pickle=False) as arrays:
        arrays = dict(arrays)
    model = mujoco.MjModel.from_xml_string(benchmark_model(ALLEGRO, "quat='0 1 0 1'"))
    data = mujoco.MjData(model)
    assert [model.joint(i).name for i in range(1, model.njnt)] == arrays["joint_names"].tolist()
    data.qpos[:] = arrays["grasp_qpos"]
    mujoco.mj_kinematics(model, data)
    wrist = Rotation.from_quat(motion.wrist_quaternion[-1], scalar_first=True)
    tips = np.asarray(
        jax.jit(lambda q: keypoints(HAND, link_transforms(HAND, q)))(motion.joint_position[-1])
    )
    tips = tips[len(HAND.links) :]
    ours = wrist.apply(tips) + motion.wrist_position[-1]
    theirs = [
        data.body(finger).xpos + data.body(finger).xmat.reshape(3, 3) @ [0, 0, ALLEGRO_TIPS[finger]]
        for finger in ("thj3", "ffj3", "mfj3", "rfj3")
    ]
    assert [HAND.fingers[i] for i in range(4)] == ["thumb", "index", "middle", "ring"]
    assert np.linalg.norm(ours - theirs, axis=-1).max() < 1e-4
    # Another order would be seen
    assert np.linalg.norm(ours - np.roll(theirs, 1, 0), axis=-1).min() > 1e-2
    # The object's file frame: a point of the file is where the motion has it.
    turn = Rotation.from_quat(arrays["obj_pose"][3:], scalar_first=True)
    place = arrays["obj_pose"][:3]
    point = np.array([0.1, -0.2, 0.3])
    object_rotation = Rotation.from_quat(motion.object_quaternion[-1], scalar_first=True)
    expected = (
        object_rotation.apply(0.5 * point - motion.object_file_origin) + motion.object_position[-1]
    )
    np.testing.assert_allclose(
        turn.apply(float(arrays["obj_scale"]) * point) + place, expected, atol=1e-6
    )


def test_in_the_exam_allegro_has_the_boxes_of_menageries_model(motion):
    match = match_hand(motion)
    for link, theirs in match.solids(
        HAND.joint_links
    ).items():  # the hand that grasps has them, too
        for our_solid, solid in zip(HAND.links[link].solids, theirs, strict=True):
            assert our_solid.kind == solid.kind
            assert our_solid.size == pytest.approx(solid.size)
            np.testing.assert_allclose(our_solid.position, solid.position, atol=2e-6)
            turns = [
                Rotation.from_quat(x.quaternion, scalar_first=True).as_matrix()
                for x in (our_solid, solid)
            ]
            np.testing.assert_allclose(
                *(turn @ np.diag(our_solid.size) ** 2 @ turn.T for turn in turns), atol=1e-8
            )
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_hand(spec, benchmarked(HAND, match))
    ours = spec.compile()
    here = mujoco.MjData(ours)
    q = motion.joint_position[0]
    here.qpos[[ours.joint(joint.name).qposadr[0] for joint in HAND.joints]] = q
    mujoco.mj_kinematics(ours, here)
    theirs = mujoco.MjModel.from_xml_string(benchmark_model(ALLEGRO, "quat='0 1 0 1'"))
    there = mujoco.MjData(theirs)
    there.qpos[:] = match.qpos(np.zeros(3), Rotation.identity(), q)
    mujoco.mj_kinematics(theirs, there)

    def outlines(model, data, palm):
        """Middles of geoms, and what of their sizes and directions does not depend on how their
        axes are called.
        """
        drawn = [
            g
            for g in range(model.ngeom)
            if g not in palm and model.geom_type[g] != mujoco.mjtGeom.mjGEOM_SPHERE
        ]
        turns = data.geom_xmat[drawn].reshape(-1, 3, 3)
        spread = np.einsum("gij,gj,gkj->gik", turns, model.geom_size[drawn] ** 2, turns).reshape(
            -1, 9
        )
        rows = np.concatenate([data.geom_xpos[drawn], 1e3 * spread], 1)
        return rows[np.lexsort(np.round(rows[:, :3], 5).T)]

    palm = [ours.geom("palm_0").id]
    our_outlines = outlines(ours, here, palm)
    expected = outlines(theirs, there, [])
    assert len(our_outlines) == len(expected) == 20
    np.testing.assert_allclose(our_outlines, expected, atol=2e-6)
    np.testing.assert_allclose(ours.geom_size[palm[0]], (0.0204, 0.0565, 0.0475))
    np.testing.assert_allclose(here.geom_xpos[palm[0]], (-0.0093, 0, 0.095 - 0.0475), atol=1e-6)


def test_a_shadow_hand_is_recognised_by_its_kinematics(motion):
    """A file that has its palm elsewhere, fingers in another order under other names, and joints
    that turn back.
    """
    turned = []
    for finger in SHADOW[::-1]:
        joints = []
        for name, position, quaternion, axis in finger:
            opposite = tuple(-x for x in axis)
            joints.append((f"x{name}", position, quaternion, opposite))
        turned.append(joints)
    renamed = mujoco.MjModel.from_xml_string(
        benchmark_model(turned, "pos='0.01 0.02 0.03' quat='1 1 0 0'", root=False)
    )
    data = mujoco.MjData(renamed)
    mujoco.mj_kinematics(renamed, data)
    motion = dataclasses.replace(
        motion,
        joint_names=np.array([renamed.joint(j).name for j in range(renamed.njnt)]),
        joint_anchor=data.xanchor.copy(),
        joint_axis=data.xaxis.copy(),
        joint_link=renamed.jnt_bodyid - 2,  # the world and the root are no links
        link_parent=np.maximum(renamed.body_parentid[2:] - 2, -1),
    )
    match = match_hand(motion)
    assert match.name == "shadow"
    assert (match.sign == -1).all()
    rng = np.random.default_rng(0)
    data.qpos[:] = q = rng.uniform(*renamed.jnt_range.T)
    mujoco.mj_kinematics(renamed, data)
    model = mujoco.MjModel.from_xml_string(benchmark_model(SHADOW, "pos='0 0 0.034'"))
    theirs = mujoco.MjData(model)
    assert tuple(model.joint(i).name for i in range(1, model.njnt)) == match.hand.joints
    place = rng.normal(size=3)
    turn = Rotation.random(rng=rng)
    theirs.qpos[:] = match.qpos(place, turn, q)
    mujoco.mj_kinematics(model, theirs)
    tip = np.array([0.0, 0.0, 0.025])
    for finger in ("rh_FFJ1", "rh_MFJ1", "rh_RFJ1", "rh_LFJ1", "rh_THJ1"):
        ours = data.body(f"x{finger}").xpos + data.body(f"x{finger}").xmat.reshape(3, 3) @ tip
        there = theirs.body(finger).xpos + theirs.body(finger).xmat.reshape(3, 3) @ tip
        assert np.linalg.norm(turn.apply(ours) + place - there) < 1e-4


def test_hands_that_the_benchmark_lacks_are_refused_with_their_distance(motion):
    with pytest.raises(CongraspError, match="DexGraspBench has no hand like"):
        match_hand(motion_of(get_hand("human")))
    anchors = motion.joint_anchor.copy()
    anchors[5] += [0.001, 0, 0]
    with pytest.raises(CongraspError, match=r"the nearest, allegro, has a joint 0\.9\d* mm off"):
        match_hand(dataclasses.replace(motion, joint_anchor=anchors))


def test_squeezing_applies_the_policys_torque_within_the_motors_limit(motion):
    """Allegro's servos have 3 N.m/rad and 0.7 N.m, the benchmark's 5 N.m/rad."""
    ahead = np.zeros((T, 16))
    ahead[:, 0] = 0.1  # 0.3 N.m
    ahead[:, 1] = -1.0  # 3 N.m, of which the motor has 0.7
    motion = dataclasses.replace(
        motion,
        joint_position=np.tile(motion.joint_position[-1], (T, 1)),
        joint_target=motion.joint_position[-1] + ahead,
    )
    torque = 5.0 * (squeezed(HAND, motion, T - 1, 5.0) - motion.joint_position[-1])
    np.testing.assert_allclose(torque[:3], [0.3, -0.7, 0.0], atol=1e-6)


def test_a_motor_of_two_joints_squeezes_at_the_sum_of_its_joints(motion):
    """The benchmark's motor is at the sum of c q, which goes on by tau / kp: c = (1, 2), tau = 0.5,
    kp = 5.
    """
    pulled = dataclasses.replace(
        HAND, tendons=(Motor("t", {"index_2": 1.0, "index_3": 2.0}, 2.0, 0.1, 0.5),)
    )
    first = motion.joint_names.tolist().index("index_2")
    target = motion.joint_position.copy()
    target[:, first + 1] += 1.0  # the tendon is 2 rad ahead: 4 N.m, of which it has 0.5
    way = squeezed(pulled, dataclasses.replace(motion, joint_target=target), T - 1, 5.0)[
        first : first + 2
    ]
    way -= motion.joint_position[-1, first : first + 2]
    assert way @ [1.0, 2.0] == pytest.approx(0.1)
    assert way[1] == pytest.approx(2 * way[0])


def test_the_pregrasp_is_the_last_clear_state_beside_the_object_as_it_lies_in_the_grasp(motion):
    """A ball of 2 cm comes along the hand's x axis by 4 mm a frame, and ends somewhere else,
    turned.
    """
    palm = 0.0204 - 0.0093  # the surface of its capsules on that side
    gaps = np.array([0.015, 0.011, 0.007, 0.003, -0.001, -0.001])
    wrist = Rotation.from_quat(motion.wrist_quaternion, scalar_first=True)
    middle = np.stack([palm + 0.02 + gaps, 0.012 * np.ones(T), 0.05 * np.ones(T)], -1)
    motion = dataclasses.replace(
        motion,
        joint_position=np.zeros((T, 16)),
        joint_target=np.zeros((T, 16)),
        object_position=motion.wrist_position + wrist.apply(middle),
    )
    grasp = benchmark_grasp("ball", motion)
    assert grasp.object_position == pytest.approx(motion.object_position[-1])
    assert grasp.clearance == pytest.approx(0.007, abs=5e-4)  # the ball has corners
    state = grasp.states["pregrasp"]
    # Where the hand is, seen from the object, is what it was in that frame.
    for point in ([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]):
        was = wrist[2].apply(point) + motion.wrist_position[2] - motion.object_position[2]
        was = Rotation.from_quat(motion.object_quaternion[2], scalar_first=True).inv().apply(was)
        now = state.rotation.apply(point) + state.position - grasp.object_position
        np.testing.assert_allclose(grasp.object_rotation.inv().apply(now), was, atol=1e-6)


def test_the_grasp_is_that_at_the_end_of_the_approach(motion):
    removed = dataclasses.replace(motion, table=np.arange(T) < 4)
    lifted = dataclasses.replace(
        motion, about={"phases": {"grasp": 0.0, "lift": 0.03, "hold": 0.05}}, control_dt=0.01
    )
    for case, frame in ((removed, 3), (lifted, 2)):
        grasp = benchmark_grasp("ball", case)
        np.testing.assert_allclose(grasp.states["grasp"].q, motion.joint_position[frame])
        np.testing.assert_allclose(grasp.object_position, motion.object_position[frame])


def test_a_firm_grip_survives_the_exam_and_an_open_hand_does_not(motion, monkeypatch):
    """A box that a scripted grip holds: squeezed it stays through the pushes, from afar nothing
    holds it.
    """
    for name, value in (("SIZES", (0.4,)), ("_DEPTHS", (0.5,)), ("_FIRMNESS", (0.8,))):
        monkeypatch.setattr(trials, name, value)
    grip = next(grip for grip in trials.grips(HAND, TaskConfig(), 1) if grip.obj.name == "box")
    still = Rotation.identity()
    q = grip.q.astype(float)
    closed = np.clip(q + 0.14 * np.sign(HAND.q_closed - HAND.q_open), HAND.lower, HAND.upper)
    grasp = State(np.zeros(3), still, q)
    # Where no push along an axis brings the box.
    afar = State(np.array([-0.5, -0.5, -0.5]), still, HAND.q_open.astype(float))
    held = Grasp(
        name="held",
        hand=HAND,
        match=match_hand(motion),
        obj=grip.obj,
        object_position=grip.object_position.astype(float),
        object_rotation=Rotation.from_quat(grip.object_quaternion, scalar_first=True),
        origin=np.zeros(3),
        scale=1.0,
        states={"pregrasp": afar, "grasp": grasp, "squeeze": grasp._replace(q=closed)},
        clearance=0.4,
    )
    lost = held._replace(name="lost", states=dict.fromkeys(STATES, afar))
    first, second = replayed([held, lost])
    assert first.from_grasp
    assert 0.0 < first.depth_mm < 3.0
    assert 0.0 < first.pushed_mm < 3.0
    assert not (second.from_grasp or second.from_pregrasp)
    assert second.depth_mm == second.pushed_mm == 0.0


def test_the_command_and_the_example_make_the_benchmarks_files(motion, tmp_path, capsys):
    for name, held in (("ball", 1.0), ("lost", 0.0)):
        (tmp_path / "grasps" / name).mkdir(parents=True)
        save_motion(
            tmp_path / "grasps" / name / "grasp.npz",
            dataclasses.replace(motion, metrics={"held": held}),
        )
    out = tmp_path / "bench"
    assert dexgraspbench((tmp_path / "grasps",), out) == 0
    printed = capsys.readouterr().out
    assert "lost/grasp.npz: The object is not held." in printed
    assert "1 grasps" in printed
    script = [
        sys.executable,
        str(ROOT / "examples" / "dexgraspbench.py"),
        str(out),
        str(tmp_path / "graspdata"),
    ]
    subprocess.run(script, check=True, timeout=60, capture_output=True)
    # What the benchmark does: this file is ours, made a moment ago.
    data = np.load(tmp_path / "graspdata/ball/congrasp/0.npy", allow_pickle=True).item()
    assert {name: data[name].shape for name in data if name.endswith(("qpos", "pose"))} == {
        "pregrasp_qpos": (23,),
        "grasp_qpos": (23,),
        "squeeze_qpos": (23,),
        "obj_pose": (7,),
    }
    assert data["obj_scale"] == 0.5
    assert data["joint_names"] == list(BENCHMARK_HANDS["allegro"].joints)
    # Mass by the benchmark's formula, and the pieces where it looks for them, in the file's unit.
    info = json.loads((out / "object/ball/info/simplified.json").read_text())
    coefficient = info["mass"] / (info["density"] * info["scale"] ** 3)
    pieces = [
        trimesh.load(path)
        for path in sorted((out / data["obj_path"] / "urdf/meshes").glob("*.obj"))
    ]
    volume = 4 / 3 * np.pi * 0.02**3
    assert coefficient * data["obj_scale"] ** 3 == pytest.approx(volume, rel=0.1)
    assert sum(piece.volume for piece in pieces) == pytest.approx(coefficient, rel=1e-5)
    with pytest.raises(CongraspError, match="exists already"):
        dexgraspbench((tmp_path / "grasps",), out)


def save_motions(folder, **motions):
    for name, motion in motions.items():
        (folder / name).mkdir(parents=True)
        save_motion(folder / name / "grasp.npz", motion)


def test_every_motion_has_a_name_of_its_own(motion, tmp_path):
    for above in ("1/a", "2/a", "3/a-2"):
        save_motions(tmp_path / above[0], **{above[2:]: motion})
    grasps, left_out = read_grasps([tmp_path / x for x in "123"])
    assert [grasp.name for grasp in grasps] == ["a", "a-2", "a-2-2"]
    assert not left_out


def test_one_motion_that_cannot_be_exported_is_left_out(motion, tmp_path):
    flat = dataclasses.replace(
        motion, object_vertices=motion.object_vertices * np.float32([1, 1, 0])
    )
    moved = dataclasses.replace(
        motion, joint_anchor=motion.joint_anchor + 0.001 * np.arange(16)[:, None]
    )
    save_motions(tmp_path / "in", flat=flat, good=motion, moved=moved)
    (tmp_path / "in" / "torn").mkdir()
    (tmp_path / "in" / "torn" / "grasp.npz").write_bytes(b"PK")
    grasps, left_out = read_grasps([tmp_path / "in"])
    assert [grasp.name for grasp in grasps] == ["good"]
    reasons = {"flat": "has no volume", "moved": "no hand like", "torn": "motion"}
    for (name, word), line in zip(reasons.items(), left_out, strict=True):
        assert f"{name}/grasp.npz" in line
        assert word in line
    with pytest.raises(CongraspError, match=r"None of the motions can be exported.*has no volume"):
        read_grasps([tmp_path / "in" / "flat"])
