"""`congrasp dataset`: verified grasps of many objects, in shards."""

import dataclasses
import hashlib
import pathlib
from typing import Annotated, Literal

import tyro

from congrasp.actors.physics import PhysicsName
from congrasp.common.errors import CongraspError
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.cli.console import in_range, tracked

Verdict = Literal["all", "success", "held", "clean", "lifted", "pushed_weight", "pushed"]


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Make a dataset of verified grasps: Parquet shards with a schema, and a card with counts and
    rates.

    Every episode is simulated to its end: held for two seconds without the table, lifted by 15 cm,
    pushed. A second run of the same command makes the missing shards. The same policy, objects,
    seed, engine and batch give the same shards.

    Examples:
      congrasp dataset meshes/ --out grasps --per-object 100
      congrasp dataset all:0-9999 --out grasps --keep clean pushed --part 3/20
    """

    objects: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Meshes (STL, OBJ, PLY, GLB), object files, folders of them, names in --folder, or objects of
    the generator as FAMILY:FIRST-LAST (mug:0-99, all:0-9999)."""
    out: pathlib.Path = pathlib.Path("dataset")
    """Folder of the dataset."""
    per_object: int = 100
    """Episodes of each object, evenly over the constraints; those that an object does not allow are
    left out.
    """
    constraints: tuple[str, ...] = ()
    """Sampled sets of constraints, with + between those of a set, such as: heading pose+trajectory.
    By default every constraint of the policy, and the paper's compositions."""
    keep: tuple[Verdict, ...] = ("held",)
    """Outcomes that an episode needs to be written; all writes every episode."""
    part: str = "1/1"
    """K/N makes every N-th shard from the K-th on. Different parts may run anywhere: copy their
    shards together, and run the command once more for the card."""
    shard: int = 0
    """Largest number of objects in a shard; 0 chooses by --per-object."""
    policy: pathlib.Path | None = None
    """A policy file; by default the pretrained one of the hand."""
    hand: str = "human"
    """Hand of the pretrained policy."""
    physics: PhysicsName = "auto"
    """Engine; auto takes warp on an NVIDIA GPU and native (MuJoCo C) on a CPU."""
    batch: int = 0
    """Number of parallel worlds; 0 uses the engine's default."""
    seed: int = 0
    """Seed of constraints and episodes."""
    licence: str = "Apache-2.0"
    """Licence of the data, for the card (an SPDX name)."""
    folder: str = "objects"
    """Folder of objects, which can be named in place of files."""
    mesh: Annotated[ImportOptions, tyro.conf.OmitArgPrefixes] = ImportOptions(unit="guess")  # noqa: RUF009
    """Conversion of meshes to objects."""

    def __call__(self) -> int:
        """Makes the missing shards, and the card."""
        from congrasp.actors.physics import resolve_physics
        from congrasp.common.policy import bundle as bundles
        from congrasp.common.policy.pretrained import policy_file
        from congrasp.common.task.constraints import require_known
        from congrasp.services.dataset.card import write_card
        from congrasp.services.dataset.make import Recipe, make, pools_of, shard_objects
        from congrasp.services.dataset.shards import CARD, Shards
        from congrasp.services.evaluate.experiment import Experiment
        from congrasp.services.evaluate.plan import ALIGNED
        from congrasp.services.evaluate.pools import most_objects
        from congrasp.services.evaluate.results import provenance
        from congrasp.services.evaluate.scores import known_rows
        from congrasp.services.grasp.jobs import find_objects

        in_range(1, per_object=self.per_object)
        in_range(0, shard=self.shard, batch=self.batch)
        turn, parts = _part(self.part)
        found, errors = find_objects(self.objects, self.folder)
        if errors or not found:
            raise CongraspError(
                errors[0].error if errors else "No objects were named.",
                "Name meshes, folders or mug:0-99.",
            )
        file = policy_file(self.policy, self.hand)
        bundle, engine = bundles.load(file), resolve_physics(self.physics)
        in_range(0, most_objects(engine), "objects", shard=self.shard)
        asked = tuple(dict.fromkeys(self.constraints)) or tuple(
            known_rows(("single", "composed"), bundle.task)
        )
        require_known(
            [name for one in asked for name in one.removesuffix(ALIGNED).split("+")], bundle.task
        )
        recipe = Recipe(
            experiment=Experiment(bundle, [], physics=engine, seed=self.seed, batch=self.batch),
            policy_sha256=hashlib.sha256(file.read_bytes()).hexdigest(),
            objects=found,
            options=self.mesh,
            per_object=self.per_object,
            constraints=asked,
            keep=tuple(name for name in dict.fromkeys(self.keep) if name != "all"),
            shard=self.shard or shard_objects(self.per_object),
        )
        pools = pools_of(recipe)
        shards = Shards(self.out, len(pools.make), recipe.columns)
        facts = {"licence": self.licence, **provenance()}
        finished = shards.finished(recipe.about)
        if (self.out / CARD).exists():
            # Drops the checksums of deleted shards: on a GPU a shard made again may differ.
            write_card(shards, recipe.about, facts)
        wanted = [number for number in range(turn, shards.total, parts) if number not in finished]
        with tracked() as track:
            total = min(len(found), pools.size * len(wanted)) * self.per_object
            make(recipe, shards, pools, wanted, track("Episodes", total))
        card = write_card(shards, recipe.about, facts)
        episodes, kept = (
            sum(own[name] for own in card["counts"].values()) for name in ("episodes", "kept")
        )
        made = card["shards"]["finished"]
        print(
            f"{kept:,} of {episodes:,} episodes are kept, in {made} of {shards.total} shards in "
            f"{self.out}."
        )
        return 0


def _part(text: str) -> tuple[int, int]:
    """K - 1 and N of K/N."""
    turn, slash, parts = text.partition("/")
    if slash and turn.isdecimal() and parts.isdecimal() and 1 <= int(turn) <= int(parts):
        return int(turn) - 1, int(parts)
    raise CongraspError(f"--part is '{text}'.", "Write K/N with K from 1 to N: --part 3/20")


COMMAND = Dataset
