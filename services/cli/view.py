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
from congrasp.services.ops.logs import announced, log

if TYPE_CHECKING:
    from congrasp.services.studio.grasping import Loaders

_RUN = "quickstart"


@dataclasses.dataclass(frozen=True)
class View:
    """Request a grasp in the browser and play it: set the heading, paint the avoid region, draw the
    wrist's path.

    With a run's folder, or with --connect, it uses the newest weights of a run in training and
    shows the run: its curves, its actors and their episodes. With a run's folder, or with
    --recordings, a click on a curve finds the episodes of that time.

    Examples:
      congrasp view runs/mine
      congrasp view --objects my-objects --port 8080
    """

    run_dir: Annotated[pathlib.Path | None, tyro.conf.Positional] = None
    """Folder of a run on this machine, live or finished, in place of --connect, --run, --recordings
    and --policy.
    """
    objects: pathlib.Path | None = None
    """Custom objects: a mesh, a folder of meshes, or a folder of 'congrasp objects import'."""
    policy: pathlib.Path | None = None
    """A policy file, reread whenever it changes; by default the pretrained ones."""
    connect: str = ""
    """Endpoint of a learner to follow, such as tcp/10.0.0.5:7447."""
    run: str = _RUN
    """Name of the run to follow."""
    recordings: pathlib.Path | None = None
    """Folder of the recordings (*.mcap) of a live or finished run."""
    host: str = "127.0.0.1"
    """Interface of the page. There is no password: every client that reaches it can use it."""
    port: int = 7480
    """Port of the page; 0 takes a free one."""
    allow_host: tuple[str, ...] = ()
    """Names under which a proxy on this machine offers the page, such as hub.example.org."""
    insecure: bool = False
    """Offer the page beyond loopback."""
    certs: pathlib.Path | None = None
    """Folder of certificates (congrasp certs), for --connect: an observer's, and a server's to
    grasp with the weights of the run."""

    def __call__(self) -> int:
        """Offers the page until a signal."""
        view = self if self.run_dir is None else self._of_folder(self.run_dir)
        with contextlib.ExitStack() as starting:
            starting.enter_context(
                announced("Loading the policies and compiling the studio's rules")
            )
            # Ctrl-C interrupts the start, which may compile for a minute
            with view._page() as url, on_signal() as stop:
                starting.close()
                print(f"The studio is at {url} (Ctrl-C ends it)", flush=True)
                stop.wait()
        print(f"The studio ends: {stop.reason}.", flush=True)
        return stop.exit_code

    def _of_folder(self, run_dir: pathlib.Path) -> "View":
        """The page of a run: of its learner if that responds, else of its newest policy."""
        from congrasp.learner.run_directory import POLICY_FILE, learner_url, open_run

        if self.connect or self.policy or self.recordings or self.run != _RUN:
            raise CongraspError(
                f"The folder {run_dir} is in place of --connect, --run, --policy and --recordings.",
                "Give either the folder or these.",
            )
        run, connect, policy = open_run(run_dir).name, learner_url(run_dir), run_dir / POLICY_FILE
        page = dataclasses.replace(self, run=run, recordings=run_dir)
        try:
            if connect:
                urls.connect(connect, "observer", certs=self.certs).close()
                return dataclasses.replace(page, connect=connect)
        except TransportError:
            print(f"No response from the learner of {run_dir}: the page shows its files.")
        return dataclasses.replace(page, policy=policy if policy.is_file() else None)

    @contextlib.contextmanager
    def _page(self) -> Iterator[str]:
        """Offers the page while the block runs; yields its address."""
        from congrasp.services.studio import grasping, training
        from congrasp.services.studio.session import open_page

        if self.policy is not None and self.connect:
            raise CongraspError(
                f"The studio can take either {self.policy} or the weights of {self.connect}.",
                "Give one of --policy and --connect.",
            )
        host = f"[{self.host}]" if ":" in self.host else self.host
        check_exposure(f"tcp/{host}:{self.port}", None, insecure=self.insecure)
        with contextlib.ExitStack() as stack:
            window, hands = None, grasping.of_file(self.policy) if self.policy else None
            if self.connect or self.recordings:
                window = training.opened_window(self.run if self.connect else "", self.recordings)
            if window is not None and self.connect:
                watching = stack.enter_context(
                    urls.connect(self.connect, "observer", certs=self.certs)
                )
                stack.callback(training.Follower(watching, window).close)
                hands = self._of_run(watching, stack)
            shown = hands or grasping.pretrained()
            yield stack.enter_context(
                open_page(shown, self.objects, window, self.host, self.port, self.allow_host)
            )

    def _of_run(self, watching: Transport, stack: contextlib.ExitStack) -> "Loaders | None":
        """The policy of a run; None if there is only an observer's certificate."""
        from congrasp.services.studio.grasping import of_run

        pulling = watching
        if self.certs is not None:
            try:
                pulling = stack.enter_context(
                    urls.connect(self.connect, "server", certs=self.certs, run=self.run)
                )
            except CongraspError as error:
                log("warning", f"{error} The studio grasps with the pretrained policies.")
                return None
        return of_run(pulling, self.run, urls.name_on_wire("studio", self.certs, "server"))


COMMAND = View
