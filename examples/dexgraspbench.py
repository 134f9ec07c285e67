"""Makes DexGraspBench's files of those that `python -m tests.benchmarks dexgraspbench` wrote, in
its own environment.

    python dexgraspbench.py dexgraspbench DexGraspBench/output/congrasp_allegro/graspdata

Each becomes a .npy file with a pickled dictionary, which is what the benchmark reads. It needs
numpy alone, and reads without unpickling anything.
"""

import argparse
import pathlib

import numpy as np


def convert(source: pathlib.Path, target: pathlib.Path) -> int:
    """Converts all grasps below a folder.

    Args:
      source: the folder of the export.
      target: the benchmark's folder of grasps, `output/<exp_name>_<hand>/graspdata`.

    Returns:
      How many there are.
    """
    files = sorted((source / "graspdata").rglob("*.npz"))
    for file in files:
        with np.load(file, allow_pickle=False) as arrays:
            grasp = {name: arrays[name] for name in arrays.files}
        grasp["obj_scale"] = float(grasp["obj_scale"])
        grasp["obj_path"] = str((source / str(grasp["obj_path"])).resolve())
        grasp["joint_names"] = [str(name) for name in grasp["joint_names"]]
        grasp["hand"] = str(grasp["hand"])
        path = target / file.relative_to(source / "graspdata").with_suffix(".npy")
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.array(grasp, dtype=object), allow_pickle=True)
    return len(files)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "source", type=pathlib.Path, help="folder that 'tests.benchmarks dexgraspbench' wrote"
    )
    parser.add_argument(
        "target", type=pathlib.Path, help="the benchmark's output/<exp_name>_<hand>/graspdata"
    )
    arguments = parser.parse_args()
    print(f"{convert(arguments.source, arguments.target)} grasps in {arguments.target}")
