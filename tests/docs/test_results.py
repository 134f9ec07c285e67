"""Figures of record: pages show what the files say, and the files are of the policies that ship."""

import dataclasses
import hashlib
import json
import re

import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import pretrained_file, pretrained_hands
from congrasp.services.evaluate import engine_table
from congrasp.services.evaluate.published import ROOT, read_all_results, read_results
from congrasp.services.evaluate.results import KINDS, fill_tables, pages

RESULTS = read_all_results()
OF_ENGINES = [name for name in RESULTS if name.startswith(f"{engine_table.FOLDER}/")]
PUBLISHED = [name for name in RESULTS if name not in OF_ENGINES]
MARKS = "<!-- results human {kind} -->\n{text}<!-- end of results -->\n"


def test_pages_show_the_results():
    outdated = [str(path.relative_to(ROOT)) for path, _ in pages()]
    assert not outdated, "Run: python -m congrasp.services.evaluate.results"


@pytest.mark.parametrize("hand", pretrained_hands())
def test_every_shipped_policy_has_figures(hand):
    policy = RESULTS[hand].about["policy"]
    assert policy["hand"] == hand
    assert policy["method"] == "ours"
    assert {row.hand for row in RESULTS[hand].rows} == {hand}
    assert RESULTS[hand].about["exam"] == "figures"
    assert hand in RESULTS[hand].about["heading_rules"]


@pytest.mark.parametrize("name", PUBLISHED)
def test_results_are_of_the_policies_that_ship(name):
    """A new policy needs new figures: run the command in the file again."""
    for policy in RESULTS[name].about["policies"]:
        path = pretrained_file(policy["hand"]).with_name(policy["file"])
        command = RESULTS[name].about["command"]
        assert bundles.load(path).actor_sha256 == policy["actor_sha256"], command
        assert hashlib.sha256(path.read_bytes()).hexdigest() == policy["sha256"], command


@pytest.mark.parametrize("name", OF_ENGINES)
def test_engines_simulate_the_policies_that_ship(name):
    """The actor of the same hand in the engine that the name says; a critic changes no action."""
    about = RESULTS[name].about
    policy = about["policy"]
    assert name == f"{engine_table.FOLDER}/{policy['hand']}-{about['physics']}"
    assert about["exam"] == "figures"
    assert about["policies"] == [policy]
    actor = bundles.load(pretrained_file(policy["hand"])).actor_sha256
    assert actor == policy["actor_sha256"], about["command"]


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_file_is_written_by_its_command(name):
    assert f"--json docs/results/{name}.json" in RESULTS[name].about["command"]


def test_a_table_is_written_between_its_marks_and_nothing_else_changes():
    results = RESULTS["human"]
    page = "Before.\n\n" + MARKS.format(kind="rates", text="old\n") + "\nAfter.\n"
    new = fill_tables(page, {"human": results})
    assert new.startswith("Before.\n\n<!-- results human rates -->\n\n| constraint |")
    assert "old" not in new
    assert new.endswith("<!-- end of results -->\n\nAfter.\n")
    assert fill_tables(new, {"human": results}) == new
    row = results.rows[0]
    assert f"| {row.episodes} ({row.independent:.0f}) |" in new
    assert f"{100 * row.success:.1f} % (" in new
    other = dataclasses.replace(results, rows=[dataclasses.replace(row, success=0.123)])
    assert "12.3 % (" in fill_tables(page, {"human": other}) != new


def results_in(engine, rows, **about):
    """The human hand's results with some of its rows, as those of another engine."""
    human = RESULTS["human"]
    return dataclasses.replace(human, rows=rows, about={**human.about, "physics": engine, **about})


def test_engines_are_columns_and_missing_cells_not_run():
    heading, *others = RESULTS["human"].rows
    heading = dataclasses.replace(heading, success=0.9, held_2s=0.8, episodes=240)
    in_physx = dataclasses.replace(heading, success=0.7, held_2s=0.6, episodes=120)
    results = {
        "human": results_in("native", [heading, others[0]]),
        "sharpa": RESULTS["sharpa"],
        "physics/human-physx": results_in("physx", [in_physx], reference_physics="native"),
    }
    page = fill_tables(MARKS.format(kind="engines", text="old\n"), results)
    cells = [re.split(r" *\| *", line)[1:-1] for line in page.splitlines() if line.startswith("|")]
    titles = ["MuJoCo C (CPU)", "PhysX 5 (CPU)", "MJX-Warp", "MJX-JAX"]
    assert cells[0] == ["constraint", *titles]
    assert cells[2] == [
        "heading",
        "90.0 % (80.0 %), 240",
        "70.0 % (60.0 %), 120",
        "not run",
        "not run",
    ]
    assert cells[3][2:] == ["not run"] * 3
    assert len(cells) == 4
    assert re.search(r"^\* PhysX 5 \(CPU\): .*references of MuJoCo C", page, re.M)
    # A file of the same engine replaces the published results
    results["physics/human-native"] = results_in("native", [in_physx])
    page = fill_tables(page, results)
    assert page.count("70.0 % (60.0 %), 120") == 2


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_table_is_markdown(kind):
    lines = [line for line in KINDS[kind](RESULTS["human"]) if line.startswith("|")]
    assert len({line.replace("\\|", "").count("|") for line in lines}) <= 1
    assert bool(lines) == (kind not in ("conditions", "headings"))


def test_conditions_name_the_policy_the_machine_and_the_command():
    about = RESULTS["human"].about
    text = "\n".join(KINDS["conditions"](RESULTS["human"]))
    for part in (
        about["policy"]["sha256"][:12],
        about["machine"],
        about["command"],
        about["version"],
    ):
        assert part in text


@pytest.mark.parametrize("marks", ["human nothing", "unknown rates"])
def test_a_mark_without_results_is_an_error(marks):
    with pytest.raises(CongraspError, match="does not exist"):
        fill_tables(f"<!-- results {marks} -->\n<!-- end of results -->", RESULTS)


def test_a_file_of_another_kind_is_an_error(tmp_path):
    file = tmp_path / "human.json"
    file.write_text(json.dumps({"rows": [{"success": 1.0}]}))
    with pytest.raises(CongraspError, match="not a results file"):
        read_results(file)
    file.write_text(json.dumps({"rows": []}))
    with pytest.raises(CongraspError, match="lacks"):
        read_results(file)
