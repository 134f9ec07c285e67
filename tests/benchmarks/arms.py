"""Grasps of objects on several arms: how many get a motion, and what forbids the rest."""

import collections
import json
import pathlib
from typing import Any

from congrasp.actors.attempts import Phases
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.io.files import write_atomically
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import policy_file
from congrasp.services.arm.options import ArmOptions
from congrasp.services.arm.planner import ArmMotion, ArmPlanner
from congrasp.services.arm.robot import Infeasible
from congrasp.services.assets.objects.named import objects_at
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.export.motion_file import GraspMotion
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

    def __init__(self, planners: dict[str, ArmPlanner]):
        self._planners = planners
        self.side = next(iter(planners.values())).side
        self.begin()

    def begin(self) -> None:
        """Forgets what was done with the object of before."""
        self.done: dict[str, dict[str, Any]] = {}
        self.refused = {name: collections.Counter[str]() for name in self._planners}

    def plan(self, obj: GraspObject, motion: GraspMotion) -> ArmMotion:
        """Tries it with the arms that have done none; raises `Infeasible` while there are any."""
        for name, planner in self._planners.items():
            if name in self.done:
                continue
            try:
                planned = planner.plan(obj, motion)
                self.done[name] = planned.facts()
            except Infeasible as limit:
                self.refused[name][str(limit)] += 1
        if len(self.done) < len(self._planners):
            raise Infeasible("an arm")
        return planned


def bench_arms(
    objects: pathlib.Path,
    robots: pathlib.Path,
    arms: tuple[str, ...],
    hand: str,
    attempts: int,
    out: pathlib.Path | None,
) -> None:
    """Prints what each arm can do with each object; see `python -m tests.benchmarks arms --help`."""
    bundle = bundles.load(policy_file(None, hand))
    planners = {
        name: ArmPlanner(
            ArmOptions(arm=str(robots / name / "robot.xml"), arm_speed=SPEEDS.get(name, "")), get_hand(bundle.spec.hand)
        )
        for name in arms
    }
    every = AllArms(planners)
    grasper = Grasper(bundle, attempts=attempts, rounds=1, phases=Phases(3.0, 0.15), arm=every)
    rows: dict[str, Any] = {}
    for folder in sorted(path for path in objects.iterdir() if path.is_dir()):
        every.begin()
        try:
            grasper.grasp(objects_at(folder)[0].load(ImportOptions(unit="guess")))
        except CongraspError as error:
            print(error)
        rows[folder.name] = {
            name: {"facts": every.done.get(name), "refused": dict(every.refused[name])} for name in arms
        }
        done = "  ".join(f"{name} {'yes' if name in every.done else 'no'}" for name in arms)
        print(f"{folder.name:16s} {done}", flush=True)
        if out:
            write_atomically(out, json.dumps(rows, indent=1).encode())
    for name in arms:
        _summarize(name, [row[name] for row in rows.values()])


def _summarize(name: str, rows: list[dict[str, Any]]) -> None:
    """Prints how many objects an arm can grasp, the worst figures of those, and what forbids how many attempts."""
    facts = [row["facts"] for row in rows if row["facts"]]
    figures = ("arm_error_mm", "arm_error_deg", "arm_speed_share", "arm_acceleration")
    worst = {key: round(max((fact[key] for fact in facts), default=0.0), 2) for key in figures}
    limits = sum((collections.Counter(row["refused"]) for row in rows), collections.Counter())
    print(f"{name}: {len(facts)} of {len(rows)}, worst {worst}, forbidden {limits.most_common()}")
