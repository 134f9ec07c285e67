"""`congrasp view`: the constraint studio, and the window on a training, in a browser."""

import pathlib


def view(
    objects: pathlib.Path | None = None,
    policy: pathlib.Path | None = None,
    connect: str = "",
    run: str = "quickstart",
    recordings: pathlib.Path | None = None,
    host: str = "127.0.0.1",
    port: int = 7480,
    insecure: bool = False,
    certs: pathlib.Path | None = None,
) -> int:
    """Ask for a grasp in the browser and see it: set the heading, paint the avoid region, draw the wrist's path.

    With --connect it takes the newest weights of a run that is being trained and shows the run: its curves, its actors
    and their episodes. With --recordings a click on a curve finds the episodes of that time.

    Args:
      objects: Your own objects: a mesh, a folder of meshes, or what 'congrasp objects import' made.
      policy: A policy file, read again when it changes; by default the pretrained ones.
      connect: A learner's endpoint, such as tcp/10.0.0.5:7447, to attach to.
      run: Name of the run that is attached to.
      recordings: Folder of a run's recordings (*.mcap), of a live run or of one that is over.
      host: Interface of the page. There is no password: whoever reaches it can use it.
      port: Port of the page; 0 takes a free one.
      insecure: Offer the page beyond loopback.
      certs: Folder of an observer's certificate (congrasp certs), for --connect.

    Examples:
      congrasp view runs/mine
      congrasp view --objects my-objects --port 8080
    """
    from services.ops.shutdown import on_signal
    from services.viz.studio.app import open_view

    with (
        on_signal() as stop,
        open_view(
            objects=objects,
            policy=policy,
            connect=connect,
            run=run,
            recordings=recordings,
            host=host,
            port=port,
            insecure=insecure,
            certs=certs,
        ) as url,
    ):
        print(f"The studio is at {url} (Ctrl-C ends it)", flush=True)
        stop.wait()
        return stop.exit_code


COMMAND = view
