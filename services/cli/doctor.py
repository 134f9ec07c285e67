"""`congrasp doctor`: this machine."""

import pathlib


def doctor(
    connect: str = "",
    run: str = "quickstart",
    folder: pathlib.Path = pathlib.Path(),
    certs: pathlib.Path | None = None,
) -> int:
    """Look for what is wrong with this machine or installation: versions, GPU, ports, disk, clock, certificates.

    One line for each thing that was looked at, with the remedy where it is not well; the exit code is 1 if any is not.

    Args:
      connect: A learner's endpoint that should be reachable from here; its clock is compared with this one.
      run: Name of the learner's run.
      folder: Where runs are to be written.
      certs: Folder of certificates (congrasp certs) to look at, and to connect with as an observer.

    Examples:
      congrasp doctor
      congrasp doctor --connect tcp/10.0.0.5:7447 --run human
    """
    from congrasp.services.ops.doctor import examine

    findings = examine(connect, run, folder, certs)
    for finding in findings:
        print(f"{'ok  ' if finding.fine else 'BAD '} {finding.what:13s} {finding.text}")
    return 0 if all(finding.fine for finding in findings) else 1


COMMAND = doctor
