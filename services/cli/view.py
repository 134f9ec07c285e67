"""`congrasp view`: the constraint studio, and the training window, in a browser."""

import dataclasses
import pathlib
from typing import Annotated

import tyro

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
        import contextlib

        from congrasp.services.ops.lifetime import on_signal
        from congrasp.services.ops.logs import announced

        starting = contextlib.ExitStack()
        starting.enter_context(announced("Loading the policies and compiling the studio's rules"))
        from congrasp.services.studio.app import open_view

        options = dataclasses.asdict(self if self.run_dir is None else self._of_folder(self.run_dir))
        del options["run_dir"]
        with on_signal() as stop, starting, open_view(names=options.pop("allow_host"), **options) as url:
            starting.close()
            print(f"The studio is at {url} (Ctrl-C ends it)", flush=True)
            stop.wait()
            return stop.exit_code

    def _of_folder(self, run_dir: pathlib.Path) -> "View":
        """The page of a run: of its learner if that responds, else of its newest policy."""
        from congrasp.common.errors import CongraspError, TransportError
        from congrasp.common.transport import urls
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


COMMAND = View
