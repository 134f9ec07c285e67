"""Record of an import: facts of the hand, and the notes (`congrasp hands import --json`)."""

import dataclasses
import json
import pathlib
from collections.abc import Mapping

from congrasp.common.errors import CongraspError
from congrasp.common.hands.files import hand_sha256
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.spec import chain_of
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_json
from congrasp.common.io.records import record_of
from congrasp.services.assets.hands.model_files import Proposal

_MAX_FILE_BYTES = 1 << 20


@dataclasses.dataclass(frozen=True)
class ImportRecord:
    """Facts of an imported hand, and the notes of its import."""

    version: str
    """Version of congrasp."""
    command: str
    machine: str
    hand: str
    """Name of the hand."""
    hand_sha256: str
    """Hash of the hand (`common.hands.files.hand_sha256`)."""
    palm: str
    """Name of the palm in the file."""
    fingers: tuple[tuple[str, ...], ...]
    """Links of each finger, from the palm to the tip; the thumb is first."""
    joints: int
    motors: int
    links: int
    mass_kg: float
    opening_mm: float
    """Distance between the tips of thumb and other fingers in the open pose (`GraspFrame`)."""
    object_scale: float
    """Factor on the size of the objects in training."""
    notes: tuple[str, ...]
    """Doubtful proposals and omissions."""


def write_import(path: pathlib.Path, proposal: Proposal, provenance: Mapping[str, str]) -> None:
    """Writes the record of an import as JSON for `read_import`.

    Args:
      path: the file.
      proposal: the imported hand.
      provenance: version, command and machine.
    """
    hand = proposal.hand
    record = ImportRecord(
        **provenance,
        hand=hand.name,
        hand_sha256=hand_sha256(hand),
        palm=proposal.palm,
        fingers=tuple(chain_of(hand, hand.links[i].name) for i in hand.tip_links),
        joints=len(hand.joints),
        motors=len(hand.motors),
        links=len(hand.links),
        mass_kg=round(sum(link.mass for link in hand.links), 3),
        opening_mm=round(1000 * float(grasp_frame(hand).opening), 1),
        object_scale=hand.object_scale,
        notes=proposal.notes,
    )
    write_atomically(path, json.dumps(dataclasses.asdict(record), indent=1).encode() + b"\n")


def read_import(path: pathlib.Path) -> ImportRecord:
    """Reads a file of `write_import`.

    Raises:
      CongraspError: it cannot be read.
    """
    remedy = "Create it with 'congrasp hands import --json'."
    content = read_json(path, _MAX_FILE_BYTES, remedy)
    try:
        return record_of(ImportRecord, content)
    except ValueError as error:
        raise CongraspError(f"{path} is not the record of an import: {error}.", remedy) from None
