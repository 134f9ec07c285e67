"""`congrasp doctor`: this machine."""


def doctor() -> int:
    """Look for what is wrong with this machine or installation: versions, GPU, port, disk, clock."""
    from services.doctor import examine

    findings = examine()
    for finding in findings:
        print(f"{'ok  ' if finding.fine else 'BAD '} {finding.what:12s} {finding.text}")
    return 0 if all(finding.fine for finding in findings) else 1


COMMAND = doctor
