"""The public face: every name is there, is imported when it is used, and the client needs numpy and
zenoh alone.
"""

import importlib.metadata
import inspect
import re
import textwrap

import numpy as np
import pytest
import trimesh

import congrasp
from tests.base_install import run_in_base_install, steady_server
from tests.children import python
from tests.short_grasps import short_pushes

CLIENT = """
import congrasp
assert not [name for name in sys.modules if name.startswith(("congrasp.", "numpy", "zenoh"))]
congrasp.Answer, congrasp.Policy, congrasp.UnknownConstraintError
import numpy as np
try:
    congrasp.load_policy
except congrasp.CongraspError as error:
    print(error)
try:
    congrasp.PolicyClient("tcp/127.0.0.1:1", wait=0.1)
except congrasp.RefusedError:
    raise SystemExit("nobody refused anything")
except congrasp.TransportError:
    pass
with congrasp.PolicyClient("tcp/127.0.0.1:{port}", hand="allegro", wait=30) as policy:
    try:
        policy.reset(congrasp.GraspRequest({{"heading": {{"direction": (0, 0, -1)}}}}))
    except congrasp.RefusedError as error:
        print(error)
    rest, level = np.array([0.0, 0.0, 0.05]), np.array([1.0, 0.0, 0.0, 0.0])
    with congrasp.Guard(policy, hold=30.0) as guard:
        q, ticker = np.array(policy.metadata()["open_pose"]), congrasp.Ticker(100.0)
        heading = {{"heading": {{"position": np.zeros(3), "direction": (0, 0, -1)}}}}
        begin = {{"surface": np.zeros((8, 3)), "q": q, "wrist": (rest, level), "object_pose": (rest, level)}}
        guard.reset(congrasp.GraspRequest(heading, **begin))
        command = None
        while command is None or command.mode != "follow":
            ticker.wait()
            command = guard.step({{"q": q, "u": np.zeros(6), "object_position": rest, "object_quaternion": level}})
    print(command.mode, command.q_target.shape, isinstance(command, congrasp.Command))
"""


def test_every_public_name_is_there_and_documented():
    assert dir(congrasp) == sorted(congrasp.__all__)
    for name in congrasp.__all__:
        member = getattr(congrasp, name)
        assert member.__name__ == name
        assert inspect.getdoc(member)
    with pytest.raises(AttributeError, match="no attribute 'grab'"):
        congrasp.grab  # noqa: B018


def test_older_name_of_an_episode_still_works():
    assert congrasp.GraspMotion is congrasp.Episode


def test_a_source_tree_without_an_installed_distribution_has_a_version_too(monkeypatch):
    assert congrasp.__version__ == importlib.metadata.version("congrasp")
    monkeypatch.setattr(importlib.metadata.Distribution, "discover", lambda **context: iter(()))
    assert congrasp.__version__ == "not installed"


def test_client_guard_and_errors_need_numpy_and_zenoh_alone():
    with steady_server() as port:
        done = run_in_base_install(CLIENT.format(port=port))
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("congrasp.load_policy needs the package '")
    assert lines[0].endswith("'. Run: pip install 'congrasp[train]'")
    assert lines[1:] == [
        "The request lacks 'surface' and 'q' and 'wrist' and 'object_pose'. Pass the measured "
        "values to GraspRequest.",
        "follow (16,) True",
    ]


def test_a_probe_of_a_server_s_health_and_options_without_presets_load_neither_jax_nor_mujoco():
    code = (
        "import sys, congrasp.services.serve.load as _\nfrom congrasp.services.cli.main import "
        "load\n"
    )
    code += "[load(name) for name in ('query', 'serve', 'view', 'doctor', 'plot', 'export')]\n"
    code += "print({'jax', 'mujoco'} & {*sys.modules})"
    assert python("-c", code).stdout == "set()\n"


def test_a_grasp_is_one_call_and_its_motion_a_file(tmp_path, monkeypatch, paper_policy):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    mesh = tmp_path / "block.stl"
    trimesh.creation.box((0.05, 0.06, 0.14)).export(mesh)
    with short_pushes():
        grasp = congrasp.grasp(mesh, heading=(0, 0, -1), attempts=4)
    assert isinstance(grasp, congrasp.Grasp)
    assert 1 <= grasp.held <= grasp.attempts
    assert grasp.success
    np.testing.assert_allclose(grasp.motion.goal["heading_direction"], [0, 0, -1], atol=1e-6)
    congrasp.save_motion(str(tmp_path / "block.npz"), grasp.motion)
    assert congrasp.load_motion(str(tmp_path / "block.npz")).object == "block"
    with pytest.raises(
        congrasp.UnknownConstraintError, match="does not support the constraint 'fingers'"
    ):
        congrasp.grasp(mesh, fingers="thumb index", attempts=4, policy=paper_policy)


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        ({"policy": "none.safetensors"}, "none.safetensors cannot be read"),
        ({"attempts": 0}, "attempts is 0"),
        ({"seed": -1}, "The seed is -1"),
    ],
)
def test_a_grasp_names_a_missing_policy_no_attempts_and_an_impossible_seed(options, fault):
    with pytest.raises(congrasp.CongraspError, match=fault):
        congrasp.grasp("mug:7", **options)


@pytest.mark.slow
def test_the_first_example_of_grasp_runs_on_the_policy_that_comes_with_congrasp(
    capsys: pytest.CaptureFixture,
) -> None:
    assert congrasp.grasp.__doc__ is not None
    example = congrasp.grasp.__doc__.partition("Example:")[2].partition("Args:")[0]
    exec(textwrap.dedent(example.strip("\n")), {})
    assert re.fullmatch(r"True [1-8] of 8 attempts hold it\n", capsys.readouterr().out)
