"""A policy as ONNX or StableHLO, with normalisation inside."""

import io
import json
import pathlib
import zipfile

import jax
import jax.export
import jax.numpy as jnp

from congrasp.common.io.files import write_atomically
from congrasp.common.policy.bundle import PolicyBundle, mean_action
from congrasp.services.export.onnx_model import onnx_model
from congrasp.services.export.policy_description import describe

SUFFIXES = {"onnx": ".onnx", "stablehlo": ".stablehlo.zip"}
_PLATFORMS = ("cpu", "cuda", "tpu")


def export_policy(bundle: PolicyBundle, kind: str, path: pathlib.Path) -> None:
    """Writes a policy.

    Args:
      bundle: the policy.
      kind: onnx or stablehlo.
      path: the file.

    Raises:
      CongraspError: the file cannot be written.
    """
    content = onnx_model(bundle) if kind == "onnx" else _stablehlo(bundle)
    write_atomically(path, content)


def _stablehlo(bundle: PolicyBundle) -> bytes:
    """A ZIP with `policy.jax` (for `jax.export.deserialize`), `policy.mlirbc` (portable StableHLO)
    and `meta.json`.
    """
    layout = bundle.spec.layout
    parameters = jax.device_get(bundle.inference_parameters)
    size = sum(width for _, width in layout)
    function = jax.jit(lambda observation: mean_action(layout, parameters, observation))
    batch = jax.export.symbolic_shape("batch")[0]
    argument = jax.ShapeDtypeStruct((batch, size), jnp.float32)
    exported = jax.export.export(function, platforms=_PLATFORMS)(argument)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("policy.jax", exported.serialize())
        archive.writestr("policy.mlirbc", exported.mlir_module_serialized)
        archive.writestr("meta.json", json.dumps(describe(bundle), indent=1))
    return buffer.getvalue()
