"""The command line as a user meets it: help, and one clear line for bad input."""

import contextlib
import errno
import functools
import os
import re
import signal
import socket
import subprocess
import sys
import textwrap
import threading
from pathlib import Path
from unittest import mock

import pytest
import trimesh

from congrasp.common.errors import CongraspError, MissingPackageError
from congrasp.common.transport.ports import free_port
from congrasp.services.cli import console
from congrasp.services.cli import main as cli
from congrasp.services.cli.main import COMMANDS, load
from congrasp.services.ops.logs import announce_progress
from tests.children import python
from tests.printed import errors

ROOT = Path(__file__).parents[2]
URDF = ROOT / "tests" / "hands" / "claw.urdf"
MESH = str(ROOT / "examples" / "mug.obj")


congrasp = functools.partial(python, "-m", "congrasp")
"""Runs the command line in a process of its own."""


def is_one_line(code: int, printed: str, words: str) -> None:
    """What was said on the standard error is one line with these words, and the exit code tells of
    bad input.
    """
    assert code not in (0, 1), printed
    (line,) = errors(printed)
    assert line.startswith("congrasp: error: ")
    assert re.search(words, line), line


def test_help_names_every_command_and_every_command_exists():
    done = congrasp("--help")
    assert done.returncode == 0
    for name in COMMANDS:
        assert name in done.stdout
        load(name)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["levitate"], "no command 'levitate'"),
        (
            ["train", "--ppo.learningrate", "1"],
            "Unrecognized options: --ppo.learningrate.*meant --ppo.learning-rate",
        ),
        (["train", "--updates", "many"], "--updates.*'many'"),
        (["train", "--physics", "abacus"], "'abacus'.*'native'"),
        (["render", "hnad"], "hnad.*--help"),
        (
            ["render", "episode", "/dev/null", "--moments", "0"],
            "--frames is 0. It must be at least 1",
        ),
        (["warmup", "--preset", "nonsense"], "no preset 'nonsense'"),
        (["train", "--method", "pd"], "'pd' does not learn.*evaluate --method pd"),
        (
            ["evaluate", "--method", "graspxl"],
            "has the method 'ours', not 'graspxl'.*train --method graspxl",
        ),
        (["train", "--task.hand", "paw"], "no hand 'paw'"),
        (["train", "--resume", "--run-dir", "/nonexistent-run"], "is not a run directory"),
        (
            ["evaluate", "--policy", "/nonexistent.safetensors"],
            "--policy: there is no file /nonexistent.safetensors",
        ),
        (
            ["evaluate", "--json", "/dev/null/x.json"],
            "--json is /dev/null/x.json, but /dev/null is a file",
        ),
        (
            ["grasp", "mug:7", "--out", "/dev/null/x"],
            "--out is /dev/null/x, but /dev/null is a file",
        ),
        (
            ["objects", "generate", "--out", "/dev/null"],
            "--out is the file /dev/null. Pass a folder",
        ),
        (["reproduce", "--out", "/dev/null"], "--out is the file /dev/null. Pass a folder"),
        (["report", "--out", "/"], "--out is the folder /. Pass a file"),
        (
            ["render", "hand", "--out", "hand.pdf"],
            "--out is hand.pdf, but the picture is a PNG. End its name in .png",
        ),
        (
            ["objects", "show", "mug:7", "--png", "x.jpg"],
            "--png is x.jpg, but the picture is a PNG",
        ),
        (["export", "policy", "--out", "/"], "--out is the folder /. Pass a file"),
        (["export", "motion", "/", "--out", "/dev/null/x.glb"], "--out is /dev/null/x.glb, but"),
        (
            ["plot", "/nonexistent-run", "--out", "/dev/null"],
            "--out is the file /dev/null. Pass a folder",
        ),
        (
            ["hands", "train", "no-hand", "--out", "/dev/null"],
            "--out is the file /dev/null. Pass a folder",
        ),
        (
            ["constraints", "import", "grab", "/", "--objects", "/dev/null"],
            "--objects is the file /dev/null. Pass a",
        ),
        (["grasp", "mug:7", "--out", "/dev/null"], "--out is the file /dev/null. Pass a folder"),
        (["serve", "--hand", "paw"], "no hand 'paw'"),
        (
            ["serve", "--hand", str(URDF)],
            "claw.urdf is a robot description.*'congrasp hands import .*claw.urdf'",
        ),
        (["serve", "--policy", "a", "--connect", "tcp/127.0.0.1:1"], "either a or"),
        (["serve", "--policy", "/nonexistent"], "cannot be read"),
        (["actor", "--connect", "nonsense"], "endpoint"),
        (["plot", "/nonexistent-run"], "nonexistent-run"),
        (["plot", "x" * 300], "x cannot be used: File name too long"),
        (["status", "/dev/null"], "/dev/null is not a run directory"),
        (
            ["grasp", "mug:7", "--policy", "/nonexistent.safetensors"],
            "there is no file /nonexistent.safetensors",
        ),
        (["grasp", "mug:7", "--policy", "/"], "/ is not a regular file"),
        (["grasp", "mug:7", "--seed", "-1"], "--seed: a seed is a whole number from 0 to 1e[+]15"),
        (["evaluate", "--seed", "9" * 23], "--seed: a seed is a whole number"),
        (["train", "--objects.seed", "9" * 23], "--objects.seed: a seed is a whole number"),
        (
            ["grasp", "mug:7", "--attempts", "100000000"],
            "--attempts is 100000000. It must be between 1 and 1024",
        ),
        (["grasp", "mug:7", "\u2014attempts", "2"], "dash of typeset text. Type --attempts"),
        (["grasp"], "nothing to grasp"),
        (["grasp", ""], "An argument is empty"),
        (["grasp", "mug:7", "--out", ""], "--out is empty"),
        (["grasp", "mug:7", "--approach", "-1"], "--approach is -1.0. It must be between 0 and"),
        (["grasp", "mug:7", "--approach", "11"], "--approach is 11.0. It must be between 0 and"),
        (["grasp", "mug:7", "--lift", "0.6"], "--lift is 0.6. It must be between 0 and"),
        (["grasp", "mug:7", "--lift", "nan"], "--lift is nan. It must be between 0 and"),
        (["objects", "generate", "--out", "/nonexistent-out", "--count", "0"], "--count is 0"),
        (["objects", "import"], "nothing to import"),
        (["objects", "import", "nothing"], "no file or folder nothing. Check the path"),
        *(
            (
                ["objects", "import", MESH, f"--{key}", value],
                f"--{key} is .*It must be positive, and at most {end}[.]",
            )
            for key, value, end in (
                *(
                    ("mass", "0", "50 kg"),
                    ("mass", "300", "50 kg. Give kilograms"),
                    ("density", "-1", "25000 kg/m.3"),
                ),
                *(
                    ("density", "25001", "25000 kg/m.3"),
                    ("scale", "0", "1e9"),
                    ("scale", "1e10", "1e9"),
                ),
                *(
                    ("scale", "inf", "1e9"),
                    ("max-pieces", "0", "1e19"),
                ),
            )
        ),
        (
            ["objects", "import", MESH, "--material", "wood", "--density", "3"],
            "--material and --density are mutually exclusive",
        ),
        (["objects", "list", "/nonexistent-folder"], "no folder"),
        (
            ["serve", "--metrics-port", "99999999"],
            "metrics cannot be served at .*:99999999.*--metrics-port",
        ),
        (["view", "--recordings", "/dev/null", "--port", "0"], "/dev/null is not a recording"),
        (
            ["learner", "--run-dir", "/nonexistent-run", "--listen", "tcp/0.0.0.0:7447"],
            "other machines.*--certs",
        ),
        (["serve", "--listen", "tcp/[::]:7457"], "other machines.*--certs.*--insecure"),
        (
            ["serve", "--workers", "2", "--listen", "tls/127.0.0.1:64321"],
            "needs certificates.*--certs",
        ),
        (["train", "--listen", "tcp/10.0.0.5:7447"], "other machines.*--certs"),
        (
            ["actor", "--certs", "/nonexistent-certs"],
            "missing.*congrasp certs issue .*--role actor",
        ),
        (
            ["certs", "issue", "/nonexistent-certs", "--role", "actor"],
            "no authority.*congrasp certs init",
        ),
    ],
)
def test_bad_input_is_one_line_and_a_non_zero_exit(arguments, words, exit_code_of, capfd):
    code = exit_code_of(arguments)
    is_one_line(code, capfd.readouterr().err, words)


@pytest.mark.parametrize("out", ["link", "link/grasps"])
def test_an_output_behind_a_link_to_nothing_is_refused(tmp_path, out):
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    with pytest.raises(CongraspError, match="link is a file or a broken link"):
        cli.run(["objects", "generate", "--out", str(tmp_path / out)])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train", "--physics", "warp", "--run-dir", "/nonexistent-run"], "NVIDIA GPU"),
        (["query", "--connect", "tcp/127.0.0.1:1", "--repeat", "2"], "127.0.0.1:1"),
    ],
)
def test_libraries_add_nothing_to_the_line(arguments, words):
    """In a process that imports JAX, MuJoCo and Zenoh for the first time."""
    done = congrasp(*arguments)
    lines = done.stderr.splitlines(keepends=True)
    errors = [line for line in lines if not line.startswith("Waiting for the policy server at ")]
    is_one_line(done.returncode, "".join(errors), words)


def test_a_failed_start_does_not_wait_for_kernels_that_are_being_built(tmp_path):
    program = (
        "import time; import congrasp.services.cli.main as cli; from congrasp.actors.physics "
        "import ENGINES; "
        "ENGINES['native'] = ENGINES['native']._replace(prepare=lambda *_: time.sleep(3600)); "
        "cli.main()"
    )
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        options = ["--physics", "native", "--actors", "0"]
        arguments = ["train", *options, "--run-dir", str(tmp_path / "run"), "--metrics-port", port]
        command = [sys.executable, "-c", program, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    is_one_line(done.returncode, done.stderr, f"metrics cannot be served at .*:{port}")


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (
            OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/data/version"),
            "/data/version could not be written: No space left on device. Free space and start "
            "again.",
        ),
        (
            OSError(errno.EIO, os.strerror(errno.EIO)),
            "A file could not be read or written, because its disk failed. Try another path.",
        ),
        (
            OSError(errno.EMFILE, os.strerror(errno.EMFILE), "/data/mug.obj"),
            "Too many open files. Raise the limit ('ulimit -n 1024'), and start again.",
        ),
        (
            FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp']"),
            "There is no folder for temporary files that can be written. Set TMPDIR to one.",
        ),
    ],
)
def test_a_full_or_failing_disk_is_reported_in_one_line(error, line, monkeypatch, capsys):
    def fail(arguments):
        raise error

    monkeypatch.setattr(cli, "run", fail)
    with pytest.raises(SystemExit) as end:
        cli.main([])
    assert end.value.code == 2
    assert capsys.readouterr().err.splitlines() == [f"congrasp: error: {line}"]


@pytest.mark.parametrize("name", ["JAX_PLATFORMS", "MUJOCO_GL", ""])
def test_a_variable_at_which_a_library_fails_is_named(name, monkeypatch, capsys):
    # As JAX, without a platform
    error = RuntimeError(f"invalid value for {name}") if name else AssertionError()
    error.add_note("For simplicity, JAX has removed its internal frames from the traceback.")
    monkeypatch.setattr(cli, "run", mock.Mock(side_effect=error))
    monkeypatch.delenv(name or "JAX_PLATFORMS", raising=False)
    with pytest.raises(type(error)):
        cli.main([])
    monkeypatch.setenv(name or "JAX_PLATFORMS", "abacus")
    with pytest.raises(SystemExit, match="2"):
        cli.main([])
    expected = f"{name} is 'abacus', which does not work here (invalid value for {name})"
    line = expected if name else "JAX_PLATFORMS is 'abacus', which does not work here"
    assert capsys.readouterr().err == f"congrasp: error: {line}. Correct or unset it.\n"


def test_reader_that_is_gone_ends_a_table(monkeypatch):
    """As rich reports it, whose consoles raise SystemExit(1)."""

    def write(arguments):
        try:
            raise BrokenPipeError
        except BrokenPipeError:
            sys.exit(1)

    monkeypatch.setattr(cli, "run", write)
    with pytest.raises(SystemExit, match=str(cli.UNREAD)):
        cli.main([])


def test_numpy_warnings_reach_no_user():
    program = """
        import functools, numpy as np
        from congrasp.services.cli import main
        def work():
            np.zeros(1) / np.zeros(1), np.mean(np.zeros(0)), np.float64(1e300) * np.float64(1e300)
        main.load = lambda name: lambda rest: functools.partial(work)
        main.main(["plot"])
    """
    done = python("-c", textwrap.dedent(program))
    assert done.returncode == 0
    assert done.stderr == ""


def test_jax_variable_whose_value_an_error_quotes_is_named(monkeypatch, capsys):
    error = RuntimeError("Unknown backend: 'abacus' requested")
    monkeypatch.setattr(cli, "run", mock.Mock(side_effect=error))
    monkeypatch.setenv("JAX_PLATFORM_NAME", "abacus")
    with pytest.raises(SystemExit, match="2"):
        cli.main([])
    (line,) = capsys.readouterr().err.splitlines()
    assert "JAX_PLATFORM_NAME is 'abacus'" in line


@pytest.mark.parametrize("flags", ["--nonsense", "no_such_file"])
def test_unknown_flags_of_xla_are_an_error(flags, tmp_path):
    arguments = ("train", "--run-dir", tmp_path / "run")
    done = python("-m", "congrasp", *arguments, env={"XLA_FLAGS": flags})
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f"XLA_FLAGS is '{flags}'" in line
    assert not (tmp_path / "run").exists()


def test_a_failed_assertion_of_a_traced_function_is_a_bug_where_the_cpu_is_a_platform(monkeypatch):
    error = AssertionError()
    error.add_note("For simplicity, JAX has removed its internal frames from the traceback.")
    monkeypatch.setattr(cli, "run", mock.Mock(side_effect=error))
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    with pytest.raises(AssertionError):
        cli.main([])


@pytest.mark.parametrize(
    ("said", "what"),
    [
        (
            "NOT_FOUND: None.\nRESOURCE_EXHAUSTED: Out of memory while trying to allocate "
            "40.02GiB. [error]",
            "Out of memory while trying to allocate 40.02GiB",
        ),
        (
            "RESOURCE_EXHAUSTED: Failed to allocate request for 16.00GiB (17179869184B) on device "
            "ordinal 0",
            "Failed to allocate request for 16.00GiB (17179869184B) on device ordinal 0",
        ),
        (
            "Failed to allocate 9000 bytes on device 'cuda:0'",
            "Failed to allocate 9000 bytes on device 'cuda:0'",
        ),
        ("INTERNAL: CUDA_ERROR_OUT_OF_MEMORY", "OUT_OF_MEMORY"),
    ],
)
def test_insufficient_memory_is_one_line(said, what, monkeypatch, capsys):
    monkeypatch.setattr(cli, "run", mock.Mock(side_effect=RuntimeError(said)))
    with pytest.raises(SystemExit) as end:
        cli.main([])
    assert end.value.code == 1
    (line,) = errors(capsys.readouterr().err)
    assert line.startswith(
        f"congrasp: error: The device's memory does not suffice: {what}. Choose fewer "
        f"--environments"
    )


@pytest.mark.parametrize(
    "error",
    [
        ImportError("libEGL.so.1: cannot open shared object file: No such file or directory"),
        ImportError("/lib/libstdc++.so.6: version `GLIBCXX_3.4.32' not found (required by x.so)"),
        OSError("libgomp.so.1: cannot open shared object file: No such file or directory"),
    ],
    ids=str,
)
def test_a_library_that_does_not_load_is_named(error, monkeypatch, capsys):
    def refuse(arguments):
        raise error

    monkeypatch.setattr(cli, "run", refuse)
    with pytest.raises(SystemExit) as end:
        cli.main(["hands"])
    library = re.escape(str(error).partition(":")[0])
    is_one_line(end.value.code, capsys.readouterr().err, f"cannot be loaded .*{library}")


@pytest.mark.parametrize(
    "number", [errno.EACCES, errno.EROFS, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG]
)
def test_an_unusable_path_is_one_line_but_a_bug_is_not(number, monkeypatch, capsys):
    def refuse(arguments):
        raise OSError(number, os.strerror(number), *arguments)

    monkeypatch.setattr(cli, "run", refuse)
    with pytest.raises(SystemExit) as end:
        cli.main(["/data/grasps"])
    is_one_line(
        end.value.code,
        capsys.readouterr().err,
        f"/data/grasps cannot be used: {os.strerror(number)}. Check",
    )
    with pytest.raises(
        OSError, match=os.strerror(number)
    ):  # it names nothing that a user could mend
        cli.main([])


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_log_on_a_full_disk_does_not_change_the_exit_code():
    """Only bad input ends a run's process for good; another code would start it again and again."""
    with open("/dev/full", "wb") as full:
        assert (
            congrasp(
                "levitate", stdout=full, stderr=full, capture_output=False, timeout=60
            ).returncode
            == 2
        )


def test_a_reader_that_is_gone_is_no_error():
    reader, writer = os.pipe()
    os.close(reader)  # as `head` does when it has read enough
    options = {"stdout": writer, "stderr": subprocess.PIPE, "capture_output": False, "timeout": 60}
    done = congrasp("hands", "list", "--help", **options)
    os.close(writer)
    lines = errors(done.stderr)
    assert not lines
    assert done.returncode in (0, 128 + signal.SIGPIPE)


def test_an_output_without_some_characters_gets_escapes():
    done = congrasp("objects", "list", "ü", env={"PYTHONIOENCODING": "ascii"})
    is_one_line(done.returncode, done.stderr, r"no folder .*\\xfc")


@pytest.mark.parametrize(
    ("shell", "code", "words"),
    [
        ("exec {} -m congrasp objects list --families >&-", 0, ""),
        (
            "mkdir a && cd a && rmdir ../a && exec {} -m congrasp objects generate --out b",
            2,
            "working folder does not",
        ),
    ],
)
def test_closed_output_and_removed_folder_are_not_bugs(tmp_path, shell, code, words):
    command = ["sh", "-c", shell.format(sys.executable)]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == code, done.stderr
    assert words in done.stderr, done.stderr
    assert "Traceback" not in done.stderr, done.stderr


@pytest.mark.parametrize("late", [True, False])
def test_a_late_thread_ends_with_the_process_without_the_interpreter_s_shutdown(late):
    """Its native code would abort there, and the run's supervisor would start the process again."""
    code = f"""
import atexit, sys, threading
from congrasp.services.cli.main import main
atexit.register(print, "shut down")
threading.Thread(target=threading.Event().wait, args=(60 if {late} else 0,), daemon=True, name="zenoh-close").start()
sys.argv[1:] = ["hands", "list"]
main()
"""
    done = python("-c", code, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "allegro" in done.stdout, done.stderr
    assert done.stdout.endswith("shut down\n") is not late


def test_a_command_runs_in_any_thread_of_a_program(capsys):
    """Python signals the main thread alone."""
    codes: list[int] = []
    with mock.patch.dict(os.environ):
        thread = threading.Thread(target=lambda: codes.append(cli.run(["hands", "list"])))
        thread.start()
        thread.join(60.0)
    assert codes == [0]
    assert "allegro" in capsys.readouterr().out


def test_a_busy_port_is_named_and_no_run_is_begun(tmp_path, exit_code_of, capfd):
    port = free_port()
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", port))
        busy.listen()
        listen = f"tcp/127.0.0.1:{port}"
        code = exit_code_of(["learner", "--run-dir", str(tmp_path / "run"), "--listen", listen])
    is_one_line(code, capfd.readouterr().err, f"127.0.0.1:{port} is in use")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("package", "extra", "arguments"),
    [
        ("matplotlib", "viz", ["evaluate", "--table", "noise", "--pictures", "pictures"]),
        ("imageio_ffmpeg", "train", ["grasp", "mug:7", "--video"]),
    ],
)
def test_a_missing_package_is_named_before_the_work(package, extra, arguments, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with (
        mock.patch.dict(os.environ),
        pytest.raises(MissingPackageError, match=rf"'{package}'.*congrasp\[{extra}\]"),
    ):
        cli.run(arguments)


def test_without_a_home_and_a_cache_everything_works(tmp_path):
    """One line says that nothing is cached."""
    trimesh.creation.box((0.05, 0.06, 0.07)).export(tmp_path / "box.stl")
    environment = {
        name: text for name, text in os.environ.items() if not name.startswith(("XDG_", "JAX_COMP"))
    }
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "congrasp",
            "objects",
            "import",
            tmp_path / "box.stl",
            "--out",
            tmp_path,
        ],
        env={**environment, "HOME": "/proc/nowhere", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "box.safetensors").is_file(), done.stderr
    assert done.stderr.count("/proc/nowhere") == done.stderr.count("XDG_CACHE_HOME") == 1


def test_a_misspelt_file_is_named_before_anything_is_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mug.obj").touch()
    monkeypatch.setattr(cli, "load", lambda name: pytest.fail("the command's module was imported"))
    with pytest.raises(
        CongraspError, match=r"There is no file .*mugg\.obj\. Did you mean .*mug\.obj\?"
    ):
        cli.run(["grasp", str(tmp_path / "mugg.obj"), "--out", "new.obj"])
    with pytest.raises(
        CongraspError, match=r"--pose: there is no file .*far\.npz\. Check the path\."
    ):
        cli.run(["grasp", str(tmp_path / "mug.obj"), "--pose", str(tmp_path / "far.npz:3")])


def test_long_work_alone_is_announced_with_its_duration(
    capsys: pytest.CaptureFixture,
) -> None:
    with announce_progress("Compiling", first=60.0):
        pass
    assert not capsys.readouterr().err
    lines: list[str] = []
    with announce_progress("Compiling", first=0.01, every=0.01):
        while len(lines) < 2:
            lines += capsys.readouterr().err.splitlines()
    assert set(lines) == {"Compiling: 0 s so far."}


def test_progress_without_a_terminal_names_task_and_counts(capsys, monkeypatch):
    monkeypatch.setattr(
        console, "announce_progress", functools.partial(announce_progress, first=0.01, every=0.01)
    )
    with console.tracked() as track:
        track("heading", 12)(5)
        capsys.readouterr()
        lines: list[str] = []
        while len(lines) < 2:
            lines += capsys.readouterr().err.splitlines()
    assert lines[-1] == "heading, 5 of 12: 0 s so far."


def test_a_phase_without_counts_has_no_total(monkeypatch):
    monkeypatch.setattr(console, "announce_progress", lambda task: contextlib.nullcontext())
    with console.bars() as progress:
        phases = console.PhaseBar(progress, "Starting")
        phases.update("mug: Attempting", 360, 400)
        assert console.current_activity(progress) == "mug: Attempting, 360 of 400"
        phases.update("mug: Drawing", 0, 0)
        assert console.current_activity(progress) == "mug: Drawing"
        phases.update("mug: Drawing", 1, 3)
        assert console.current_activity(progress) == "mug: Drawing, 1 of 3"


def test_a_bar_without_a_step_shows_no_counts(monkeypatch):
    monkeypatch.setattr(console, "announce_progress", lambda task: contextlib.nullcontext())
    with console.bars() as progress:
        task = progress.add_task("Episodes", total=12)
        assert console.current_activity(progress) == "Episodes"
        assert str(console.Counts().render(progress.tasks[0])) == ""
        progress.update(task, completed=3)
        assert "3/12" in str(console.Counts().render(progress.tasks[0]))
