"""`congrasp view`: the constraint studio, and the training window, in a browser."""

import contextlib
import dataclasses
import pathlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import tyro

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.security import check_exposure
from congrasp.services.ops.lifetime import on_signal
from congrasp.services.ops.logs import announce_progress, log

if TYPE_CHECKING:
    from congrasp.services.studio.grasping import Loaders

_RUN = "quickstart"


@dataclasses.dataclass(frozen=True)
class View:
    """Open the studio in a browser: set the heading, paint the avoid region, draw the wrist's path,
    and watch the resulting grasp.

    With a run's folder or --connect, the studio grasps with the newest weights of a run in training
    and shows its curves, its actors and their episodes. With a run's folder or --recordings, a
    click on a curve lists the episodes of that time.

    Examples:
      congrasp view runs/mine
      congrasp view --objects my-objects --port 8080
    """

    run_dir: Annotated[pathlib.Path | None, tyro.conf.Positional] = None
    """Folder of a live or finished run on this machine. It replaces --connect, --run, --recordings
    and --policy.
    """
    objects: pathlib.Path | None = None
    """Your own objects: a mesh, a folder of meshes, or a folder of 'congrasp objects import'."""
    policy: pathlib.Path | None = None
    """A policy file, which is read again whenever it changes; by default the pretrained
    policies."""
    connect: str = ""
    """Endpoint of the learner of a run, such as tcp/10.0.0.5:7447."""
    run: str = _RUN
    """Name of the learner's run, with --connect."""
    recordings: pathlib.Path | None = None
    """Folder with recordings (*.mcap) of a live or finished run."""
    host: str = "127.0.0.1"
    """Interface at which the page is offered. There is no password: everyone with access to this
    interface can use the page."""
    port: int = 7480
    """Port of the page; 0 takes a free port."""
    allow_host: tuple[str, ...] = ()
    """Host names under which a proxy on this machine offers the page, such as hub.example.org."""
    insecure: bool = False
    """Allow --host to offer the page to other machines."""
    certs: pathlib.Path | None = None
    """Folder of certificates (congrasp certs) for --connect: that of an observer, and that of a
    server to grasp with the weights of the run."""

    def __call__(self) -> int:
        """Offers the page until a signal."""
        view = self if self.run_dir is None else self.of_folder(self.run_dir)
        with contextlib.ExitStack() as starting:
            starting.enter_context(
                announce_progress("Loading the policies and compiling the studio's rules")
            )
            # Signals are handled only then: Ctrl-C interrupts the start, which may compile for a
            # minute.
            with view._page() as url, on_signal() as stop:
                starting.close()
                print(f"The studio is at {url} (Ctrl-C ends it)", flush=True)
                stop.wait()
        print(f"The studio ends: {stop.reason}.", flush=True)
        return stop.exit_code

    def of_folder(self, run_dir: pathlib.Path) -> "View":
        """Returns the page of a run's learner if that responds, else of its newest policy.

        Raises:
          CongraspError: the folder is not a run directory, or other options are set.
        """
        from congrasp.learner.run_directory import POLICY_FILE, learner_url, open_run

        if self.connect or self.policy or self.recordings or self.run != _RUN:
            raise CongraspError(
                f"The folder {run_dir} cannot be combined with --connect, --run, --policy or "
                "--recordings.",
                "Pass either the folder or these options.",
            )
        name = open_run(run_dir).name
        page = dataclasses.replace(self, run=name, recordings=run_dir)
        endpoint = learner_url(run_dir)
        if endpoint and self._is_live(endpoint):
            return dataclasses.replace(page, connect=endpoint)
        if endpoint:
            print(f"No response from the learner of {run_dir}: the page shows its files.")
        policy = run_dir / POLICY_FILE
        if not policy.is_file():
            return page
        return dataclasses.replace(page, policy=policy)

    def _is_live(self, endpoint: str) -> bool:
        """Returns True if a learner accepts a connection."""
        try:
            urls.connect(endpoint, "observer", certs=self.certs).close()
        except TransportError:
            return False
        return True

    @contextlib.contextmanager
    def _page(self) -> Iterator[str]:
        """Offers the page while the block runs; yields its address."""
        from congrasp.services.studio import grasping, training
        from congrasp.services.studio.session import open_page

        if self.policy is not None and self.connect:
            raise CongraspError(
                f"The studio can take either {self.policy} or the weights of {self.connect}.",
                "Pass one of --policy and --connect.",
            )
        host = f"[{self.host}]" if ":" in self.host else self.host
        check_exposure(f"tcp/{host}:{self.port}", None, insecure=self.insecure)
        with contextlib.ExitStack() as stack:
            window = None
            loaders = None
            if self.policy:
                loaders = grasping.of_file(self.policy)
            if self.connect or self.recordings:
                followed_run = self.run if self.connect else ""
                window = training.open_window(followed_run, self.recordings)
            if window is not None and self.connect:
                observer = stack.enter_context(
                    urls.connect(self.connect, "observer", certs=self.certs)
                )
                follower = training.Follower(observer, window)
                stack.callback(follower.close)
                loaders = self._loaders_of_run(observer, stack)
            if not loaders:
                loaders = grasping.pretrained()
            page = open_page(loaders, self.objects, window, self.host, self.port, self.allow_host)
            yield stack.enter_context(page)

    def _loaders_of_run(self, observer: Transport, stack: contextlib.ExitStack) -> "Loaders | None":
        """Returns the loaders of a run's policy; None if there is only an observer's certificate.

        Args:
          observer: connection to the learner, used without certificates.
          stack: closes the connection with a server's certificate.
        """
        from congrasp.services.studio.grasping import of_run

        transport = observer
        if self.certs is not None:
            try:
                transport = stack.enter_context(
                    urls.connect(self.connect, "server", certs=self.certs, run=self.run)
                )
            except CongraspError as error:
                log("warning", f"{error} The studio grasps with the pretrained policies.")
                return None
        name = urls.name_on_wire("studio", self.certs, "server")
        return of_run(transport, self.run, name)


COMMAND = View
