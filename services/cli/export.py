"""`congrasp export`: policies and motions for other programs, each file checked as it is written."""

import pathlib
from typing import Literal


def policy(
    policy: pathlib.Path | None = None,
    hand: str = "human",
    to: Literal["onnx", "stablehlo"] = "onnx",
    out: pathlib.Path | None = None,
) -> int:
    """Write a policy as ONNX or StableHLO, and print by how much it differs from the original on random inputs.

    Normalisation is inside; the file also holds the hand, the meaning and order of every input and output, and the
    hand's MuJoCo model. docs/exports.md says how to use it; examples/onnx_grasp.py does.

    Args:
      policy: The policy file (.safetensors); the shipped one otherwise.
      hand: Whose shipped policy.
      to: The format.
      out: The file to write; policy.onnx or policy.stablehlo.zip otherwise.
    """
    from common.policy.bundle import load
    from common.policy.shipped import policy_file
    from services.export.policy import SUFFIXES, TOLERANCE, export_policy

    source = policy_file(policy, hand)
    path = out or pathlib.Path(f"policy{SUFFIXES[to]}")
    difference = export_policy(load(source), to, path)
    print(f"{path}: largest absolute difference to the Flax policy {difference:.1e} (at most {TOLERANCE:g})")
    return 0


COMMANDS = {"policy": policy}
