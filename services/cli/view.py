"""`congrasp view`: the constraint studio, and the training window, in a browser."""

import contextlib
import dataclasses
import functools
import pathlib
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Annotated

import tyro

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.security import check_exposure
from congrasp.services.ops.lifetime import on_signal
from congrasp.services.ops.logs import announced, log
from congrasp.services.studio.server import PageServer, Sessions

if TYPE_CHECKING:
    from congrasp.services.studio.grasping import PolicyGrasping

_RUN = "quickstart"


@dataclasses.dataclass(frozen=True)
class View:
    """Request a grasp in the browser and play it: set the heading, paint the avoid region, draw the wrist's path.

    With a run's folder, or with --connect, it uses the newest weights of a run in training and shows the run: its
    curves, its actors and their episodes. With a run's folder, or with --recordings, a click on a curve finds the
    episodes of that time.

    Examples:
      congrasp view runs/mine
      congrasp view --objects my-objects --port 8080
    """

    run_dir: Annotated[pathlib.Path | None, tyro.conf.Positional] = None
    """Folder of a run on this machine, live or finished, in place of --connect, --run, --recordings and --policy."""
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
    """Folder of certificates (congrasp certs), for --connect: an observer's, and a server's to grasp with the weights
    of the run."""

    def __call__(self) -> int:
        """Offers the page until a signal."""
        view = self if self.run_dir is None else self._of_folder(self.run_dir)
        with contextlib.ExitStack() as starting:
            starting.enter_context(announced("Loading the policies and compiling the studio's rules"))
            with on_signal() as stop, view._page() as url:
                starting.close()
                print(f"The studio is at {url} (Ctrl-C ends it)", flush=True)
                stop.wait()
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
        from congrasp.services.serve.server import follow_file
        from congrasp.services.studio.catalogue import Importer, offered
        from congrasp.services.studio.grasping import PolicyGrasping
        from congrasp.services.studio.session import Session
        from congrasp.services.studio.training import Follower, Recordings, TrainingWindow

        if self.policy is not None and self.connect:
            raise CongraspError(
                f"The studio can take either {self.policy} or the weights of {self.connect}.",
                "Give one of --policy and --connect.",
            )
        host = f"[{self.host}]" if ":" in self.host else self.host
        check_exposure(f"tcp/{host}:{self.port}", None, insecure=self.insecure)
        with contextlib.ExitStack() as stack:
            window = None
            if self.connect or self.recordings:
                recorded = Recordings(self.recordings) if self.recordings else None
                window = TrainingWindow(self.run if self.connect else _run_of(self.recordings), recorded)
                # In the background, since reading the curves of a long run takes seconds.
                threading.Thread(target=window.load, daemon=True, name="curves").start()
            if window is not None and self.connect:
                watching = stack.enter_context(urls.connect(self.connect, "observer", certs=self.certs))
                stack.callback(Follower(watching, window).close)
                hands = self._of_run(watching, stack)
            elif self.policy is not None:
                source = follow_file(self.policy)
                hands = {"of the policy": functools.partial(PolicyGrasping, source, self.policy.name)}
            else:
                hands = _pretrained()
            loaded = {name: functools.cache(load) for name, load in hands.items()}  # all browsers share programs
            opened: list[Sessions] = []  # the port is taken before they compile
            server = PageServer(lambda browser: opened[0].routes(browser), self.host, self.port, self.allow_host)
            stack.callback(server.close)
            opened.append(Sessions(lambda: Session(loaded, offered(self.objects), Importer(), window)))
            stack.callback(opened[0].close)
            yield server.url

    def _of_run(self, watching: Transport, stack: contextlib.ExitStack) -> "dict[str, Callable[[], PolicyGrasping]]":
        """The policy of a run; the pretrained ones if there is only an observer's certificate."""
        from congrasp.services.serve.server import follow_run
        from congrasp.services.studio.grasping import PolicyGrasping

        pulling = watching
        if self.certs is not None:
            try:
                pulling = stack.enter_context(urls.connect(self.connect, "server", certs=self.certs, run=self.run))
            except CongraspError as error:
                log("warning", f"{error} The studio grasps with the pretrained policies.")
                return _pretrained()
        source = follow_run(pulling, self.run, urls.name_on_wire("studio", self.certs, "server"))
        return {"of the run": functools.partial(PolicyGrasping, source, f"the run '{self.run}'")}


def _pretrained() -> "dict[str, Callable[[], PolicyGrasping]]":
    """The pretrained and custom policies, by the names of their hands."""
    from congrasp.common.policy.pretrained import hands_with_policy, policy_file
    from congrasp.services.serve.server import follow_file
    from congrasp.services.studio.grasping import PolicyGrasping

    return {
        name: functools.partial(PolicyGrasping, follow_file(policy_file(None, name)), "pretrained policy")
        for name in hands_with_policy()
    }


def _run_of(recordings: pathlib.Path | None) -> str:
    """The name of a run, from the folder of its recordings."""
    from congrasp.learner.run_directory import LOGS

    names = [part for part in recordings.resolve().parts if part != LOGS] if recordings else []
    return names[-1] if names else ""


COMMAND = View
