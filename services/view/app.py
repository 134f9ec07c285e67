"""Puts a studio together from what the command was given, and takes it apart again."""

import contextlib
import functools
import pathlib
import secrets
import threading
from collections.abc import Callable, Iterator

from common.errors import CongraspError
from common.hands import HANDS
from common.objects import procedural, store
from common.objects.meshes import ImportOptions, import_source
from common.objects.pool import HELD_OUT_SEED
from common.objects.sources import find_sources
from common.objects.spec import GraspObject
from common.policy.shipped import policy_file, shipped
from common.transport.keys import Keys, process_name
from common.transport.security import check_exposure
from common.transport.zenoh_transport import ZenohTransport
from services.access import credentials
from services.logs import say
from services.server import follow_file, follow_run
from services.view.grasping import PolicyGrasping
from services.view.recordings import Recordings
from services.view.server import PageServer
from services.view.session import Catalogue, Session
from services.view.training import Follower, TrainingWindow

_GUESS = ImportOptions(unit="guess")
_FIRST = "mug"
"""Family of the object that a studio without objects begins with."""


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
    insecure: bool,
    certs: pathlib.Path | None,
) -> Iterator[str]:
    """Offers the page while the block runs; yields its address. For the arguments see `services.cli.view`.

    Raises:
      CongraspError: something that was named is not there, or the port is busy.
    """
    if policy is not None and connect:
        raise CongraspError(
            f"The studio can take either {policy} or the weights of {connect}.", "Give one of --policy and --connect."
        )
    check_exposure(f"tcp/{f'[{host}]' if ':' in host else host}:{port}", None, insecure=insecure)
    with contextlib.ExitStack() as stack:
        window = TrainingWindow(run) if connect or recordings else None
        if recordings is not None and window is not None:
            _read(window, recordings)
        if connect:
            transport = stack.enter_context(
                ZenohTransport(connect=[connect], credentials=credentials(certs, "observer"))
            )
            transport.declare_alive(Keys(run).alive("viewer", process_name("viewer"), secrets.token_hex(4)))
            assert window is not None
            stack.callback(Follower(transport, window).close)
            following = follow_run(transport, run)
            hands: dict[str, Callable[[], PolicyGrasping]] = {
                "of the run": functools.partial(PolicyGrasping, following, f"the run '{run}'")
            }
        elif policy is not None:
            hands = {"of the policy": functools.partial(PolicyGrasping, follow_file(policy), policy.name)}
        else:
            hands = {
                name: functools.partial(PolicyGrasping, follow_file(policy_file(None, name)), "shipped policy")
                for name in HANDS
                if shipped(name) is not None
            }
        session = Session(hands, catalogue(objects), take_mesh, window, Recordings(recordings) if recordings else None)
        stack.callback(session.close)
        server = PageServer(session.gets, session.posts, host, port)
        stack.callback(server.close)
        yield server.url


def catalogue(objects: pathlib.Path | None) -> Catalogue:
    """The user's objects, then one of each procedural family; none is made or imported yet.

    Raises:
      CongraspError: there is nothing at the path.
    """
    makers: dict[str, Callable[[], GraspObject]] = {}
    if objects is not None:
        files = [objects] if objects.suffix == store.SUFFIX else sorted(objects.glob(f"*{store.SUFFIX}"))
        makers |= {file.name.removesuffix(store.SUFFIX): functools.partial(store.load, file) for file in files}
        for source in [] if files else find_sources(objects):
            makers[source.name] = functools.partial(lambda source: import_source(source, _GUESS)[0], source)
    families = sorted(procedural.FAMILIES, key=lambda family: family != _FIRST)
    makers |= {family: functools.partial(procedural.generate, HELD_OUT_SEED, family) for family in families}
    return Catalogue(makers)


def take_mesh(path: pathlib.Path) -> tuple[GraspObject, list[str]]:
    """Imports one mesh; what the user should know about it comes with it."""
    return import_source(find_sources(path)[0], _GUESS)


def _read(window: TrainingWindow, recordings: pathlib.Path) -> None:
    """Reads curves in the background: a long run's recordings take a while."""
    Recordings(recordings).check()

    def work() -> None:
        try:
            window.load(recordings)
        except CongraspError as error:
            say("warning", str(error))

    threading.Thread(target=work, daemon=True, name="curves").start()
