"""Policies and motions for other programs."""

import dataclasses
import pathlib
from typing import Annotated, Literal

import tyro

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import check_free, check_output


def policy(
    policy: pathlib.Path | None = None,
    hand: str = "human",
    to: Literal["onnx", "stablehlo"] = "onnx",
    out: pathlib.Path | None = None,
    force: bool = False,
) -> int:
    """Write a policy as ONNX or StableHLO.

    The exported program normalises its inputs. The file also contains the hand, the meaning and
    order of every input and output, and the hand's MuJoCo model. docs/policy-export.md and
    examples/onnx_grasp.py show its use.

    Args:
      policy: A policy file (.safetensors), or the name of a pretrained policy such as
        allegro-student; by default the pretrained policy of --hand.
      hand: Hand of the pretrained policy.
      to: Format of the file.
      out: The file to write; by default policy.onnx or policy.stablehlo.zip.
      force: Replace an existing file.

    Examples:
      congrasp export policy
      congrasp export policy --hand allegro --to stablehlo
    """
    from congrasp.common.policy.bundle import load
    from congrasp.common.policy.pretrained import policy_file
    from congrasp.services.export.policy import SUFFIXES, export_policy

    source = policy_file(policy, hand)
    path = out or pathlib.Path(f"policy{SUFFIXES[to]}")
    check_output("--out", path, is_folder=False)
    check_free(path, force=force)
    export_policy(load(source), to, path)
    print(path)
    return 0


@dataclasses.dataclass(frozen=True)
class ExportMotion:
    """Write a grasp motion for another program.

    Formats: glb for Blender, the web, Unity and Unreal; usd for Isaac, Houdini and Maya; bvh for
    motion capture programs; ros2 for a bag with joint trajectory, TF and URDF; lerobot for a
    dataset (version 3.0) with an episode for each motion. docs/exports.md describes them.

    Examples:
      congrasp export motion grasps/mug/grasp.npz --to glb
      congrasp export motion runs/mine --success --to ros2 --out bag
    """

    paths: Annotated[tuple[pathlib.Path, ...], tyro.conf.Positional]
    """Motions of 'congrasp grasp' (.npz), recordings (.mcap), or the folder of a run. Only lerobot
    takes several motions."""
    to: Literal["glb", "usd", "bvh", "ros2", "lerobot"] = "glb"
    """Format of the export."""
    out: pathlib.Path | None = None
    """The file or folder to write; by default one named after the object, such as mug.glb, in the
    working directory."""
    index: int = -1
    """Index of the episode in a recording, from 0; -1 is the last episode."""
    success: bool = False
    """Apply --index to successful episodes only."""
    fps: float = 0.0
    """Frames per second, such as 24 for a film; by default the 100 of the motion."""
    camera: bool = False
    """Also render videos of the motions; only lerobot has videos."""
    force: bool = False
    """Replace an existing file. Existing folders are never replaced."""

    def __call__(self) -> int:
        """Writes the motions, and prints the number of their frames."""
        from congrasp.services.export.formats import FORMATS, default_name, export_motions
        from congrasp.services.export.motions import at_rate, pick_motion

        if not self.paths:
            raise CongraspError(
                "No motion was given.",
                "Pass a .npz of 'congrasp grasp', a recording or a run's folder.",
            )
        if self.out and not self.out.exists():
            check_output("--out", self.out, is_folder=not FORMATS[self.to])
        motions = [pick_motion(path, self.index, success=self.success) for path in self.paths]
        if self.fps:
            motions = [at_rate(motion, self.fps) for motion in motions]
        target = self.out or default_name(motions[0], self.to)
        export_motions(motions, self.to, target, camera=self.camera, force=self.force)
        frames = sum(motion.steps for motion in motions)
        print(f"{target}: {frames} frames")
        return 0


def layout(
    path: Annotated[pathlib.Path, tyro.conf.Positional],
    out: pathlib.Path = pathlib.Path("congrasp-layout.json"),
    force: bool = False,
) -> int:
    """Write a layout for Foxglove: the actors' episodes in 3-D, learning curves, rewards, contacts
    and events.

    Args:
      path: The run's folder, or an MCAP file, for which the layout is made.
      out: The file to write; in Foxglove: Layout, Import from file.
      force: Replace an existing file.

    Examples:
      congrasp export layout runs/mine
      congrasp export layout recordings/learner.mcap --out layout.json
    """
    from congrasp.services.export.layout import export_layout

    check_free(out, force=force)
    panels = export_layout(path, out)
    print(f"{out}: {panels} panels")
    return 0


COMMANDS = {"policy": policy, "motion": ExportMotion, "layout": layout}
