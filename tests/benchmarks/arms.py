"""Grasps of scanned objects on several arms: how many get a motion, and what forbids the rest.

Every arm chooses among the same attempts of the policy. Run from the repository's root:
python -m tests.benchmarks.arms OBJECTS ROBOTS --arms panda ur5e iiwa xarm7
"""

import argparse
import collections
import json
import pathlib
import time

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import policy_file
from congrasp.services.arm.options import ArmOptions
from congrasp.services.arm.planner import ArmPlanner
from congrasp.services.arm.robot import Infeasible
from congrasp.services.assets.objects.named import objects_at
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.grasp.grasper import Grasper

SPEEDS = {
    "panda": "2.175 2.175 2.175 2.175 2.61 2.61 2.61",
    "ur5e": "3.14",
    "iiwa": "1.71 1.71 1.75 2.27 2.44 3.14 3.14",
    "xarm7": "3.14",
}
"""rad/s, from the makers' data sheets; the MJCF files have none."""


class AllArms:
    """Several arms in the place of one: an attempt is accepted once each of them has done some attempt."""

    name = "arms"

    def __init__(self, planners):
        self._planners = planners
        self.side = next(iter(planners.values())).side
        self.begin()

    def begin(self):
        self.done, self.refused = {}, {name: collections.Counter() for name in self._planners}

    def plan(self, obj, motion):
        for name, planner in self._planners.items():
            if name in self.done:
                continue
            begun = time.monotonic()
            try:
                self.done[name] = planner.plan(obj, motion).facts()
            except Infeasible as limit:
                self.refused[name][str(limit)] += 1
            self.refused[name]["seconds"] += time.monotonic() - begun
        if len(self.done) < len(self._planners):
            raise Infeasible("an arm")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("objects", type=pathlib.Path)
    parser.add_argument("robots", type=pathlib.Path, help="folder with NAME/robot.xml")
    parser.add_argument("--arms", nargs="+", default=list(SPEEDS))
    parser.add_argument("--names", nargs="*")
    parser.add_argument("--hand", default="allegro")
    parser.add_argument("--base", default=ArmOptions.base)
    parser.add_argument("--mount", default="")
    parser.add_argument("--attempts", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--approach", type=float, default=3.0)
    parser.add_argument("--lift", type=float, default=0.15)
    parser.add_argument("--out", type=pathlib.Path)
    given = parser.parse_args()
    bundle = bundles.load(policy_file(None, given.hand))
    hand = get_hand(bundle.spec.hand)
    arms = AllArms(
        {
            name: ArmPlanner(
                ArmOptions(
                    arm=str(given.robots / name / "robot.xml"),
                    base=given.base,
                    mount=given.mount,
                    arm_speed=SPEEDS.get(name, ""),
                ),
                hand,
            )
            for name in given.arms
        }
    )
    grasper = Grasper(
        bundle, attempts=given.attempts, rounds=given.rounds, approach=given.approach, lift=given.lift, arm=arms
    )
    rows = {}
    for folder in sorted(path for path in given.objects.iterdir() if path.is_dir()):
        if given.names and folder.name not in given.names:
            continue
        begun = time.monotonic()
        arms.begin()
        try:
            grasper.grasp(objects_at(folder)[0].load(ImportOptions(unit="guess")))
            outcome = ""
        except CongraspError as error:
            outcome = str(error)
        seconds = time.monotonic() - begun
        rows[folder.name] = {
            name: {"facts": arms.done.get(name), "refused": dict(arms.refused[name])} for name in given.arms
        }
        done = " ".join(f"{name} {'yes' if name in arms.done else 'NO'}" for name in given.arms)
        print(f"{folder.name:16s} {seconds:5.1f} s  {done}  {outcome[:60]}", flush=True)
        if given.out:
            given.out.write_text(json.dumps({"options": vars(given) | {}, "rows": rows}, default=str, indent=1))
    for name in given.arms:
        limits = collections.Counter()
        for row in rows.values():
            limits.update({k: v for k, v in row[name]["refused"].items() if k != "seconds"})
        facts = [row[name]["facts"] for row in rows.values() if row[name]["facts"]]
        worst = {key: max((f[key] for f in facts), default=0.0) for key in ("arm_error_mm", "arm_error_deg")}
        worst["speed"] = max((f["arm_speed_share"] for f in facts), default=0.0)
        worst["acceleration"] = max((f["arm_acceleration"] for f in facts), default=0.0)
        spent = sum(row[name]["refused"].get("seconds", 0.0) for row in rows.values())
        print(f"{name}: {len(facts)} of {len(rows)}; {worst}; {spent:.0f} s; {limits.most_common(8)}")


if __name__ == "__main__":
    main()
