"""`congrasp dataset`: verified grasps of many objects, in shards."""

import dataclasses
import hashlib
import pathlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from congrasp.actors.physics import PhysicsName
from congrasp.common.errors import CongraspError
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.cli.console import PhaseBar, bars, in_range

if TYPE_CHECKING:
    from rich.progress import Progress

    from congrasp.common.task.config import TaskConfig
    from congrasp.services.assets.objects.named import ObjectAt
    from congrasp.services.dataset.make import Recipe

Verdict = Literal["all", "success", "held", "clean", "lifted", "pushed_weight", "pushed"]


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Make a dataset of verified grasps: Parquet files (shards) with a schema, and a dataset card
    with counts and rates.

    Every episode is simulated to its end: the object is held for two seconds without the table,
    lifted by 15 cm, and pushed. Repeat an interrupted command to make the missing shards. The same
    policy, objects, seed, engine and batch give the same shards. All GPUs of the machine are used:
    each makes some of the shards.

    Examples:
      congrasp dataset meshes/ --out grasps --per-object 100
      congrasp dataset all:0-9999 --out grasps --keep clean pushed --part 3/20
    """

    objects: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Meshes (STL, OBJ, PLY, GLB), object files, folders of these, names of objects in --folder, or
    objects of the generator as FAMILY:FIRST-LAST (mug:0-99, all:0-9999)."""
    out: pathlib.Path = pathlib.Path("dataset")
    """Folder of the dataset."""
    per_object: int = 100
    """Number of episodes of each object, evenly divided among its constraints. Constraints that are
    impossible on an object are left out.
    """
    constraints: tuple[str, ...] = ()
    """Combinations of constraints to sample, joined by +, such as: heading pose+trajectory. By
    default every constraint of the policy, and the paper's compositions."""
    keep: tuple[Verdict, ...] = ("held",)
    """Properties that an episode must have to be written; all writes every episode."""
    part: str = "1/1"
    """K/N makes every N-th shard, beginning with shard K. Different parts can be made on different
    machines: copy their shards into one folder, and repeat the command there for the card."""
    shard: int = 0
    """Largest number of objects in a shard; 0 chooses by --per-object."""
    policy: pathlib.Path | None = None
    """A policy file; by default the pretrained policy of --hand."""
    hand: str = "human"
    """Hand of the pretrained policy."""
    physics: PhysicsName = "auto"
    """Engine; auto takes warp on an NVIDIA GPU and native (MuJoCo C) on a CPU."""
    batch: int = 0
    """Number of environments that are simulated in parallel; 0 uses the engine's default."""
    seed: int = 0
    """Seed of constraints and episodes."""
    licence: str = "Apache-2.0"
    """Licence of the data, for the card (an SPDX name)."""
    folder: str = "objects"
    """Folder of imported or generated objects, which `objects` may name instead of files."""
    mesh: Annotated[ImportOptions, tyro.conf.OmitArgPrefixes] = ImportOptions(unit="guess")  # noqa: RUF009
    """Conversion of meshes to objects."""

    def __call__(self) -> int:
        """Makes the missing shards, and the card."""
        from congrasp.services.dataset.card import write_card
        from congrasp.services.dataset.gpus import make_on_gpus
        from congrasp.services.dataset.make import make, pools_of
        from congrasp.services.dataset.shards import CARD, Shards
        from congrasp.services.evaluate.results import provenance
        from congrasp.services.train.accelerators import several_gpus

        in_range(1, per_object=self.per_object)
        in_range(0, shard=self.shard, batch=self.batch)
        first_shard, parts = _part(self.part)
        gpus = several_gpus(self.physics)
        recipe = self._recipe(gpus is not None)
        pools = pools_of(recipe)
        shards = Shards(self.out, len(pools.loaders), recipe.columns)
        accelerators = "" if gpus is None else f"{len(gpus.names)} x {gpus.kind}"
        facts = {"licence": self.licence, **provenance(accelerators)}
        finished = shards.finished(recipe.about)
        if (self.out / CARD).exists():
            # Drops the checksums of deleted shards: on a GPU a shard made again may differ.
            write_card(shards, recipe.about, facts)
        of_part = range(first_shard, shards.total, parts)
        missing = [number for number in of_part if number not in finished]
        objects = min(len(recipe.objects), pools.pool_size * len(missing))
        with bars() as display:
            progress = _episode_progress(display, objects * self.per_object)
            if gpus is None or not missing:
                make(recipe, shards, pools, missing, progress)
            else:
                make_on_gpus(recipe, shards, missing, gpus.names, progress)
        card = write_card(shards, recipe.about, facts)
        counts = card["counts"].values()
        episodes = sum(count["episodes"] for count in counts)
        kept_episodes = sum(count["kept"] for count in counts)
        print(
            f"{kept_episodes:,} of {episodes:,} episodes are kept, in {card['shards']['finished']} "
            f"of {shards.total} shards in {self.out}."
        )
        return 0

    def _recipe(self, on_gpus: bool) -> "Recipe":
        """Returns the content of all shards: policy, objects, constraints, episodes of each.

        Args:
          on_gpus: True if other processes simulate on GPUs, which this one does not see.

        Raises:
          CongraspError: there is no such object, policy or constraint, or a shard is too large for
            the engine.
        """
        from congrasp.common.policy import bundle as bundles
        from congrasp.common.policy.pretrained import policy_file
        from congrasp.services.dataset.make import Recipe, shard_objects
        from congrasp.services.evaluate.experiment import Experiment
        from congrasp.services.evaluate.pools import max_objects_with_meshes
        from congrasp.services.train.accelerators import engine_of

        objects = self._objects()
        file = policy_file(self.policy, self.hand)
        bundle = bundles.load(file)
        engine = engine_of(self.physics, on_gpus)
        in_range(0, max_objects_with_meshes(engine), "objects", shard=self.shard)
        outcomes = dict.fromkeys(self.keep)
        return Recipe(
            experiment=Experiment(bundle, [], physics=engine, seed=self.seed, batch=self.batch),
            policy_sha256=hashlib.sha256(file.read_bytes()).hexdigest(),
            objects=objects,
            options=self.mesh,
            per_object=self.per_object,
            constraints=self._constraint_sets(bundle.task),
            keep=tuple(outcome for outcome in outcomes if outcome != "all"),
            shard=self.shard or shard_objects(self.per_object),
        )

    def _objects(self) -> "list[ObjectAt]":
        """Returns the named objects; raises a CongraspError if one is missing, or none is named."""
        from congrasp.services.grasp.jobs import find_objects

        objects, errors = find_objects(self.objects, self.folder)
        remedy = "Pass meshes, folders, or objects of the generator such as mug:0-99."
        if errors:
            raise CongraspError(errors[0].error, remedy)
        if not objects:
            raise CongraspError("There are no objects.", remedy)
        return objects

    def _constraint_sets(self, task: "TaskConfig") -> tuple[str, ...]:
        """Returns the sampled sets of constraints, without repetition; raises a CongraspError for
        one with a constraint that the policy does not know.
        """
        from congrasp.common.task.constraints import require_known
        from congrasp.services.evaluate.plan import ALIGNED
        from congrasp.services.evaluate.scores import known_rows

        sets = tuple(dict.fromkeys(self.constraints))
        if not sets:
            sets = tuple(known_rows(("single", "composed"), task))
        names = []
        for constraint_set in sets:
            names += constraint_set.removesuffix(ALIGNED).split("+")
        require_known(names, task)
        return sets


def _part(text: str) -> tuple[int, int]:
    """Returns K - 1 and N of a text K/N; raises a CongraspError for another text."""
    part, slash, parts = text.partition("/")
    if slash and part.isdecimal() and parts.isdecimal() and 1 <= int(part) <= int(parts):
        return int(part) - 1, int(parts)
    raise CongraspError(f"--part is '{text}'.", "Write K/N with K from 1 to N: --part 3/20")


def _episode_progress(display: "Progress", total: int) -> Callable[[int], None]:
    """Shows that shards are prepared and, from the first episode on, how many are simulated.

    Args:
      display: the bars.
      total: number of all episodes.

    Returns:
      Function to call with the number of simulated episodes.
    """
    preparations = "Preparing objects, references and programs"
    bar = PhaseBar(display, preparations)

    def progress(episodes: int) -> None:
        """Shows the number of simulated episodes."""
        if episodes:
            bar.update("Episodes", episodes, total)
        else:
            bar.update(preparations, 0, 0)

    return progress


COMMAND = Dataset
