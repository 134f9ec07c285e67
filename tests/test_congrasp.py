"""The public face: every name is there, is imported when it is used, and the client needs numpy and zenoh alone."""

import inspect
import re
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import trimesh

import congrasp
from congrasp.common.transport import urls
from congrasp.common.transport.ports import free_port

BLOCKED = ("jax", "flax", "mujoco", "scipy", "trimesh", "mcap", "tyro", "rich", "dacite", "cryptography")
CLIENT = """
import sys
for name in {blocked}:
    sys.modules[name] = None
import congrasp
assert not [name for name in sys.modules if name.startswith(("congrasp.", "numpy", "zenoh"))]
request = congrasp.GraspRequest({{"heading": {{"direction": (0, 0, -1)}}}})
congrasp.Answer, congrasp.Policy, congrasp.UnknownConstraintError
congrasp.Guard, congrasp.Command, congrasp.JointLimits, congrasp.Ticker
try:
    congrasp.PolicyClient("tcp/127.0.0.1:1", wait=0.1)
except congrasp.RefusedError:
    raise SystemExit("nobody refused anything")
except congrasp.TransportError:
    pass
with congrasp.PolicyClient("tcp/127.0.0.1:{port}", wait=30) as policy:
    try:
        policy.reset(request)
    except congrasp.RefusedError as error:
        print(error)
"""


def test_every_public_name_is_there_and_documented():
    assert dir(congrasp) == sorted(congrasp.__all__)
    for name in congrasp.__all__:
        found = getattr(congrasp, name)
        assert found.__name__ == name and inspect.getdoc(found)
    with pytest.raises(AttributeError, match="no attribute 'grab'"):
        congrasp.grab  # noqa: B018


def test_the_client_and_its_errors_need_numpy_and_zenoh_alone():
    port = free_port()
    with urls.listen(f"tcp/127.0.0.1:{port}", "server"):
        code = CLIENT.format(blocked=BLOCKED, port=port)
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("The request lacks 'surface' and 'q' and 'wrist' and 'object_pose'.")


def test_a_grasp_is_one_call_and_its_motion_a_file(tmp_path, monkeypatch, paper_policy):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    mesh = tmp_path / "block.stl"
    trimesh.creation.box((0.05, 0.06, 0.14)).export(mesh)
    found = congrasp.grasp(mesh, heading=(0, 0, -1), attempts=4)
    assert isinstance(found, congrasp.Grasp) and 1 <= found.held <= found.attempts and found.success
    np.testing.assert_allclose(found.motion.goal["heading_direction"], [0, 0, -1], atol=1e-6)
    congrasp.save_motion(str(tmp_path / "block.npz"), found.motion)
    assert congrasp.load_motion(str(tmp_path / "block.npz")).object == "block"
    with pytest.raises(congrasp.UnknownConstraintError, match="does not support the constraint 'fingers'"):
        congrasp.grasp(mesh, fingers="thumb index", attempts=4, policy=paper_policy)


def test_the_first_example_of_grasp_runs_on_the_policy_that_comes_with_congrasp(capsys: pytest.CaptureFixture) -> None:
    assert congrasp.grasp.__doc__ is not None
    example = congrasp.grasp.__doc__.partition("Example:")[2].partition("Args:")[0]
    exec(textwrap.dedent(example.strip("\n")), {})
    assert re.fullmatch(r"True [1-8] of 8 attempts hold it\n", capsys.readouterr().out)
