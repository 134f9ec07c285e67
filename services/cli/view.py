"""`congrasp view`: the constraint studio, and the training window, in a browser."""

import pathlib
from typing import Annotated

import tyro

_RUN = "quickstart"


def view(
    run_dir: Annotated[pathlib.Path | None, tyro.conf.Positional] = None,
    objects: pathlib.Path | None = None,
    policy: pathlib.Path | None = None,
    connect: str = "",
    run: str = _RUN,
    recordings: pathlib.Path | None = None,
    host: str = "127.0.0.1",
    port: int = 7480,
    allow_host: tuple[str, ...] = (),
    insecure: bool = False,
    certs: pathlib.Path | None = None,
) -> int:
    """Request a grasp in the browser and play it: set the heading, paint the avoid region, draw the wrist's path.

    With a run's folder, or with --connect, it uses the newest weights of a run in training and shows the run: its
    curves, its actors and their episodes. With a run's folder, or with --recordings, a click on a curve finds the
    episodes of that time.

    Args:
      run_dir: Folder of a run on this machine, live or finished, in place of --connect, --run, --recordings and
        --policy.
      objects: Custom objects: a mesh, a folder of meshes, or a folder of 'congrasp objects import'.
      policy: A policy file, reread whenever it changes; by default the pretrained ones.
      connect: Endpoint of a learner to follow, such as tcp/10.0.0.5:7447.
      run: Name of the run to follow.
      recordings: Folder of the recordings (*.mcap) of a live or finished run.
      host: Interface of the page. There is no password: every client that reaches it can use it.
      port: Port of the page; 0 takes a free one.
      allow_host: Names under which a proxy on this machine offers the page, such as hub.example.org.
      insecure: Offer the page beyond loopback.
      certs: Folder of certificates (congrasp certs), for --connect: an observer's, and a server's to grasp with the
        weights of the run.

    Examples:
      congrasp view runs/mine
      congrasp view --objects my-objects --port 8080
    """
    import contextlib

    from congrasp.common.errors import CongraspError
    from congrasp.services.ops.logs import announced
    from congrasp.services.ops.shutdown import on_signal

    starting = contextlib.ExitStack()
    starting.enter_context(announced("Loading the policies and compiling the studio's rules"))
    from congrasp.services.studio.app import open_view

    if run_dir is not None:
        if connect or policy or recordings or run != _RUN:
            raise CongraspError(
                f"The folder {run_dir} is in place of --connect, --run, --policy and --recordings.",
                "Give either the folder or these.",
            )
        connect, run, policy, recordings = _of_folder(run_dir, certs)
    with (
        on_signal() as stop,
        starting,
        open_view(
            objects=objects,
            policy=policy,
            connect=connect,
            run=run,
            recordings=recordings,
            host=host,
            port=port,
            names=allow_host,
            insecure=insecure,
            certs=certs,
        ) as url,
    ):
        starting.close()
        print(f"The studio is at {url} (Ctrl-C ends it)", flush=True)
        stop.wait()
        return stop.exit_code


def _of_folder(run_dir: pathlib.Path, certs: pathlib.Path | None) -> tuple[str, str, pathlib.Path | None, pathlib.Path]:
    """--connect, --run, --policy and --recordings of a run: its learner if that responds, else its newest policy."""
    from congrasp.common.errors import TransportError
    from congrasp.common.transport import urls
    from congrasp.learner.run_directory import POLICY_FILE, learner_url, open_run

    run, connect = open_run(run_dir).name, learner_url(run_dir)
    try:
        if connect:
            urls.connect(connect, "observer", certs=certs).close()
            return connect, run, None, run_dir
    except TransportError:
        print(f"No response from the learner of {run_dir}: the page shows its files.")
    policy = run_dir / POLICY_FILE
    return "", run, policy if policy.is_file() else None, run_dir


COMMAND = view
