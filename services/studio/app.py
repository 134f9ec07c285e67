"""Opens and closes a studio with the policies, objects and run of a command line."""

import contextlib
import functools
import pathlib
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import cast

from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import HELD_OUT_SEED
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.pretrained import hands_with_policy, policy_file
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.security import check_exposure
from congrasp.learner.run_directory import LOGS
from congrasp.services.assets.objects.mesh_files import read_mesh
from congrasp.services.assets.objects.named import objects_at, one_object
from congrasp.services.assets.objects.options import ImportOptions, Unit
from congrasp.services.ops.logs import log
from congrasp.services.serve.server import follow_file, follow_run
from congrasp.services.studio.catalogue import Catalogue
from congrasp.services.studio.grasping import PolicyGrasping
from congrasp.services.studio.server import PageServer, Sessions
from congrasp.services.studio.session import Session
from congrasp.services.studio.training import Follower, Recordings, TrainingWindow

_GUESS = ImportOptions(unit="guess")
_FIRST = "mug"
"""Family of the initial object, unless the user names objects."""


@contextlib.contextmanager
def open_view(
    *,
    objects: pathlib.Path | None,
    policy: pathlib.Path | None,
    connect: str,
    run: str,
    recordings: pathlib.Path | None,
    host: str,
    port: int,
    names: Sequence[str],
    insecure: bool,
    certs: pathlib.Path | None,
) -> Iterator[str]:
    """Offers the page while the block runs; yields its address. For the arguments see `services.cli.view`.

    Raises:
      CongraspError: a named file or run does not exist, the options exclude each other, or the port is in use.
    """
    if policy is not None and connect:
        raise CongraspError(
            f"The studio can take either {policy} or the weights of {connect}.", "Give one of --policy and --connect."
        )
    check_exposure(f"tcp/{f'[{host}]' if ':' in host else host}:{port}", None, insecure=insecure)
    with contextlib.ExitStack() as stack:
        window = None
        if connect or recordings:
            recorded = Recordings(recordings) if recordings else None
            window = TrainingWindow(run if connect else _run_of(recordings), recorded)
            # In the background, since reading the curves of a long run takes seconds.
            threading.Thread(target=window.load, daemon=True, name="curves").start()
        if window is not None and connect:
            watching = stack.enter_context(urls.connect(connect, "observer", certs=certs))
            stack.callback(Follower(watching, window).close)
            hands = _of_run(connect, run, certs, watching, stack)
        elif policy is not None:
            hands = {"of the policy": functools.partial(PolicyGrasping, follow_file(policy), policy.name)}
        else:
            hands = _pretrained()
        loaded = {name: functools.cache(load) for name, load in hands.items()}  # all browsers share compiled programs
        opened: list[Sessions] = []  # the port is taken before they compile
        server = PageServer(lambda browser: opened[0].routes(browser), host, port, names)
        stack.callback(server.close)
        opened.append(Sessions(lambda: Session(loaded, catalogue(objects), MeshImporter(), window)))
        stack.callback(opened[0].close)
        yield server.url


def _of_run(
    connect: str, run: str, certs: pathlib.Path | None, watching: Transport, stack: contextlib.ExitStack
) -> dict[str, Callable[[], PolicyGrasping]]:
    """The policy of a run; the pretrained ones if there is only an observer's certificate."""
    pulling = watching
    if certs is not None:
        try:
            pulling = stack.enter_context(urls.connect(connect, "server", certs=certs, run=run))
        except CongraspError as error:
            log("warning", f"{error} The studio grasps with the pretrained policies.")
            return _pretrained()
    source = follow_run(pulling, run, urls.name_on_wire("studio", certs, "server"))
    return {"of the run": functools.partial(PolicyGrasping, source, f"the run '{run}'")}


def _pretrained() -> dict[str, Callable[[], PolicyGrasping]]:
    """The pretrained and custom policies, by the names of their hands."""
    return {
        name: functools.partial(PolicyGrasping, follow_file(policy_file(None, name)), "pretrained policy")
        for name in hands_with_policy()
    }


def catalogue(objects: pathlib.Path | None) -> Catalogue:
    """The user's objects, then one of each procedural family; none is made or imported yet.

    Raises:
      CongraspError: there is nothing at the path.
    """
    makers: dict[str, Callable[[], GraspObject]] = {}
    if objects is not None:
        makers |= {found.name: functools.partial(found.load, _GUESS) for found in objects_at(objects)}
    families = sorted(procedural.FAMILIES, key=lambda family: family != _FIRST)
    makers |= {family: functools.partial(procedural.generate, HELD_OUT_SEED, family) for family in families}
    return Catalogue(makers)


class MeshImporter:
    """Imports meshes as `congrasp objects import` does."""

    def sides(self, path: pathlib.Path) -> tuple[float, float, float]:
        """The sides of a mesh in its own unit."""
        x, y, z = read_mesh(path).extents.tolist()
        return x, y, z

    def load(self, path: pathlib.Path, unit: str) -> tuple[GraspObject, list[str]]:
        """The object of a mesh, and notes for the user."""
        obj = one_object(path, ImportOptions(unit=cast(Unit, unit)))
        return obj, list(obj.notes)


def _run_of(recordings: pathlib.Path | None) -> str:
    """The name of a run, from the folder of its recordings."""
    names = [part for part in recordings.resolve().parts if part != LOGS] if recordings else []
    return names[-1] if names else ""
