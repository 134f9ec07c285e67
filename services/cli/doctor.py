"""`congrasp doctor`: checks of this machine and installation."""

import pathlib

from congrasp.services.ops.doctor import examine


def doctor(
    connect: str = "",
    run: str = "quickstart",
    folder: pathlib.Path = pathlib.Path(),
    certs: pathlib.Path | None = None,
) -> int:
    """Check this machine and installation: versions, GPU, ports, disk, clock, certificates.

    Prints one line per check, with a remedy if it failed; the exit code is 1 if any failed. `congrasp train --preset
    check` then runs physics, messages, log, server and pictures.

    Args:
      connect: Endpoint of a learner to test; its clock is compared with this machine's.
      run: Name of the learner's run.
      folder: Folder for runs.
      certs: Folder of certificates (congrasp certs) to check, and to connect with as an observer.

    Examples:
      congrasp doctor
      congrasp doctor --connect tcp/10.0.0.5:7447 --run human
    """
    findings = examine(connect, run, folder, certs)
    for finding in findings:
        print(f"{'ok  ' if finding.fine else 'BAD '} {finding.what:13s} {finding.text}")
    fine = all(finding.fine for finding in findings)
    if fine:
        print("Next: congrasp train --preset check --actors 1 (tries physics, messages, log, server and pictures)")
    return 0 if fine else 1


COMMAND = doctor
