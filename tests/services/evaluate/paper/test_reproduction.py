"""The command from end to end on a few episodes, what a second start repeats, and what it
refuses.
"""

import html
import json

import pytest

from congrasp.common.config import NetworkConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.task.config import TaskConfig
from congrasp.services.cli.main import load
from congrasp.services.evaluate.experiment import silent
from congrasp.services.evaluate.lineup import PolicyKey, read_entrant
from congrasp.services.evaluate.paper import evaluation as part_evaluation
from congrasp.services.evaluate.paper import reproduction
from congrasp.services.evaluate.paper.evaluation import PartResult, PartSettings
from congrasp.services.evaluate.tables import Evaluation
from congrasp.services.train import reproduction as training
from congrasp.services.train.command import untrained
from tests.pages import Reader
from tests.rows import row

OURS = PolicyKey("human", "ours")


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """In the full system's place, with a network that compiles quickly; it knows no references,
    which take long.
    """
    task = TaskConfig(constraints=("heading", "affordance"))
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    bundles.save(
        untrained(RunConfig(task=task, network=NetworkConfig(hidden=(16,), encoder=4))), path
    )
    return path


@pytest.mark.timeout(600)
@pytest.mark.slow
def test_a_reproduction_writes_its_files_once(policy, tmp_path, capsys, monkeypatch):
    command = [
        "--quick",
        "--hands",
        "human",
        "--methods",
        "graspxl",
        "--policy",
        str(policy),
        "--out",
        str(tmp_path),
    ]
    command += ["--episodes", "2", "--pool", "2", "--physics", "native"]
    failed = "human-ours-composed: The method 'ours' has no row in these tables."

    def reproduced():
        """What the file says after another start, which one part of the three fails."""
        assert load("reproduce")(command)() == 1
        return json.loads((tmp_path / "reproduction.json").read_text())

    first = reproduced()
    printed = capsys.readouterr().out
    assert [part["name"] for part in first["parts"]] == ["human-ours-single", "human-ours-objects"]
    (failure,) = first["failures"]
    assert failure.startswith(failed)
    assert failed in printed
    rates = [cell for cell in first["cells"] if cell["quantity"] == "success"]
    compared = [cell for cell in rates if cell["ours"] is not None]
    assert f"{len(compared)} of the paper's 47 success rates" in printed
    assert "reproduction.html" in printed
    assert {cell["table"] for cell in compared} == {"hands", "objects"}
    assert len(compared) >= 5
    for cell in compared:
        assert 0.0 <= cell["low"] <= cell["ours"] <= cell["high"] <= 1.0
        assert cell["difference"] == pytest.approx(cell["ours"] - cell["paper"])
    assert len(first["not_comparable"]) == len(rates) - len(compared)
    page = Reader(text := (tmp_path / "reproduction.html").read_text())
    assert not page.links
    assert len(page.sources) == 2
    assert "not trained with --quick" in text
    assert failed in html.unescape(text)
    assert (tmp_path / "tables.tex").read_text().count(r"\begin{tabular}") == 6
    assert not list((tmp_path / "tables").glob("*.parts"))

    def never(*arguments, **options):
        raise CongraspError("This must not be evaluated.")

    monkeypatch.setattr(part_evaluation, "evaluate_tables", never)
    again = reproduced()
    printed = capsys.readouterr().out
    assert printed.count("evaluated before") == 2
    assert again["cells"] == first["cells"]
    assert Reader((tmp_path / "reproduction.html").read_text()).sources == page.sources
    (tmp_path / "tables" / "human-ours-single.json").write_text("{")
    assert [part["name"] for part in reproduced()["parts"]] == ["human-ours-objects"]
    command += ["--seed", "1"]
    with pytest.raises(CongraspError, match=r"Nothing could be evaluated.*must not be"):
        reproduced()


def test_policies_come_from_the_user_from_trainings_or_from_the_package(
    policy, tmp_path, monkeypatch
):
    """A method whose training fails is named with the reason, and the others are evaluated."""
    trained = []

    def train_all(request, keys, track):
        trained.extend(keys)
        return {one: "it failed" for one in keys}

    def evaluate_part(part, entrant, settings, out, track):
        trained.append(part.name)
        constraint = "heading" if part.table == "single" else "pose+trajectory"
        result_row = row(constraint, 0.9, 0.8, 0.95, hand=entrant.hand, method=entrant.method)
        about = {"pictures": [], "seconds": 1.0, "heading_rules": "Half of the headings are kept."}
        return PartResult(part, "hands", [result_row], about, True)

    monkeypatch.setattr(training, "train_all", train_all)
    monkeypatch.setattr(reproduction, "evaluate_part", evaluate_part)
    hands = ("human", "allegro")
    methods = ("pd", "graspxl")
    policies = training.get_policies(
        training.PolicyRequest(
            hands=hands,
            methods=methods,
            given={OURS: read_entrant(policy)},
            pretrained=False,
            runs=tmp_path / "policies",
        ),
        silent,
    )
    request = reproduction.Request(
        out=tmp_path,
        hands=hands,
        methods=methods,
        captured=(),
        noise=True,
        command="congrasp reproduce",
        settings=PartSettings(episodes=3, pool=3, many=6, physics="native", seed=0),
    )
    account = reproduction.reproduce(request, policies, silent)
    what = {one.name: text for one, text in account.policies}
    assert trained[:2] == [PolicyKey("allegro", "ours"), PolicyKey("human", "graspxl")]
    assert trained[2:6] == [
        "human-ours-single",
        "human-pd-single",
        "human-ours-composed",
        "human-ours-noise",
    ]
    assert what["human-ours"].startswith("policy.safetensors, version 0")
    assert what["human-pd"] == "needs none"
    assert what["allegro-ours"] == what["human-graspxl"] == "none: it failed"
    assert what["human-dgrasp"] == "none: not requested"
    assert account.failures == ["it failed", "it failed"]
    assert (tmp_path / "reproduction.html").read_text().count("Half of the headings are kept.") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--hands", "human", "--methods", "levitate"], "no method 'levitate'"),
        (
            ["--quick", "--hands", "allegro", "--policy", "{policy}"],
            "is of the hand 'human' and the method 'ours'",
        ),
        (
            ["--hands", "human", "--methods", "pd"],
            "human-ours must be trained first, and this machine has no GPU",
        ),
        (["--quick", "--hands", "paw"], "no hand 'paw'"),
        (["--patience", "0"], "--patience is 0"),
    ],
)
def test_bad_input_is_refused_before_anything_begins(
    policy, tmp_path, monkeypatch, arguments, words
):
    monkeypatch.setattr("congrasp.services.train.accelerators.detect", lambda: ("cpu", 1))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CongraspError, match=words):
        load("reproduce")([text.format(policy=policy) for text in arguments])()
    assert not list(tmp_path.iterdir())


def test_captured_sets_are_looked_for_where_the_import_puts_them(
    policy, tmp_path, capsys, monkeypatch
):
    (tmp_path / "grab" / "objects").mkdir(parents=True)
    monkeypatch.setattr(
        part_evaluation,
        "evaluate_tables",
        lambda own, *arguments, **options: Evaluation(own, [], [], [], ""),
    )
    monkeypatch.setattr(part_evaluation, "exam_pool", lambda exam, count: [])
    command = ["--quick", "--hands", "human", "--methods", "graspxl", "--policy", str(policy)]
    assert (
        load("reproduce")(
            [*command, "--captured", str(tmp_path / "grab"), "--out", str(tmp_path / "out")]
        )()
        == 1
    )
    assert "human-ours-grab: " in (printed := capsys.readouterr().out)
    assert "has no folder 'constraints'" in printed
    assert "congrasp constraints import" in printed
