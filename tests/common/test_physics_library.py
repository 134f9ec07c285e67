"""The log file of MuJoCo, which no process may leave in the user's folder."""

import subprocess
import sys

import pytest

UNSTABLE = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
)
data = mujoco.MjData(model)
data.qvel[:] = float("inf")
mujoco.mj_step(model, data)
assert sum(warning.number for warning in data.warning)
"""
ENTRIES = (
    "common.objects.resting",
    "common.objects.shapes",
    "actors.physics.native",
    "services.assets.hands.compile",
    "services.evaluate.experiment",
    "services.grasp.grasper",
    "services.gym.vector_env",
)
"""Further modules that use MuJoCo. They get it from the module that the first one gets it from
(`test_one_module_imports_mujoco`).
"""


def run(program, folder):
    subprocess.run([sys.executable, "-c", program], cwd=folder, check=True, timeout=120)


def test_unstable_physics_alone_writes_a_log(tmp_path):
    """Otherwise the next test could not fail."""
    run(UNSTABLE, tmp_path)
    assert list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "entry",
    ["common.hands.mjcf", *(pytest.param(entry, marks=pytest.mark.slow) for entry in ENTRIES)],
)
def test_unstable_physics_leaves_no_file(entry, tmp_path):
    run(f"import congrasp.{entry}\n{UNSTABLE}", tmp_path)
    assert not list(tmp_path.iterdir())


def test_warning_handler_of_the_program_stays(tmp_path):
    handler = "import mujoco\nmujoco.set_mju_user_warning(print)\n"
    check = "assert mujoco.get_mju_user_warning() is print\n"
    run(f"{handler}import congrasp.common.hands.mjcf\n{check}", tmp_path)
