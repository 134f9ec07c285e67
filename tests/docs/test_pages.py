"""The pages' form: length, words, and the extras, paths, modules and links that they name."""

import pathlib
import re
import tomllib

import pytest

from congrasp.common.task.constraints import CONSTRAINTS

ROOT = pathlib.Path(__file__).resolve().parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")),
    ROOT / "deploy" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
FREE = ("docs/notes/", "docs/reference/", "docs/glossary.md", "CHANGELOG.md")
"""The lab notebook, reference pages, glossary and the list of changes may be long."""

GENERATED = re.compile(r"<!-- results .*?<!-- end of results -->", re.S)
CODE = re.compile(r"^```.*?^```", re.M | re.S)
SPAN = re.compile(r"`[^`\n]+`")
QUOTED = re.compile(r"\*[a-z ]+\*")
TARGET = re.compile(r"\]\([^)]*\)")
BANNED = re.compile(
    r"\b(beside|anew|nobody|somebody|people|asked for|wish(es)?|what is wanted|(goes|go|going|went) on|puts? off|"
    r"told|hears?|speaks?|stands|stood|mend(s|ed|ing)?|of (one's|its|their) own|as (it is|they lie)|turned away|"
    r"put back|let in|ledger|out of all reason|surroundings?|pieces of an answer|without a word|"
    r"the (world|hand)'s (?=frame|axes|axis))\b",
    re.I,
)
"""Words that the project's prose does not use; each has a plainer one in CONTRIBUTING.md."""

FOLDERS = "common|actors|learner|services|congrasp|docs|tests|deploy|examples"
PATH = re.compile(rf"(?<![\w/.~-])(?:\.\./)*((?:{FOLDERS})/[\w./-]*[\w/])")
MODULE = re.compile(r"(?<![\w./-])((?:congrasp|tests)(?:\.\w+)+)")
MADE = ("docs/results/NAME.json", "congrasp/Grasp-v0", "learner/0/")


def name_of(page):
    return str(page.relative_to(ROOT))


def prose(page):
    """The text without generated tables, code and targets of links."""
    text = CODE.sub("", GENERATED.sub("", page.read_text()))
    return QUOTED.sub("x", TARGET.sub("]", SPAN.sub("x", text)))


def slug(heading):
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def source_of(names):
    """The longest part of a dotted name that is a module, and the rest of the names."""
    for length in range(len(names), 0, -1):
        path = ROOT.joinpath(*names[:length])
        for file in (path.with_suffix(".py"), path / "__init__.py"):
            if file.exists():
                return file, names[length:]
    raise AssertionError(".".join(names))


@pytest.mark.parametrize(
    "page", [page for page in PAGES if not name_of(page).startswith(FREE)], ids=name_of
)
def test_a_users_page_is_short(page):
    words = [word for word in prose(page).split() if re.search(r"\w", word)]
    assert len(words) <= 900, (
        "Move what was measured to docs/notes/, and tables to docs/reference/."
    )


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_page_is_written_in_plain_english(page):
    banned = {match[0].lower() for match in BANNED.finditer(prose(page))}
    assert not banned


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_extras_exist(page):
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    named = set()
    for names in re.findall(r"(?:congrasp|\.)\[([\w,]+)\]", page.read_text()):
        named.update(names.split(","))
    assert named <= extras.keys()


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_paths_and_modules_exist(page):
    text = page.read_text()
    for path in set(PATH.findall(re.sub(r"\]\([^)]*\)", "]", text))):
        assert (ROOT / path).exists() or path in MADE or path.startswith("congrasp/<run>"), path
    for module in set(MODULE.findall(text)):
        file, rest = source_of(module.split("."))
        assert not rest or re.search(rf"\b{rest[0]}\b", file.read_text()), module


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    for path, anchor in re.findall(
        r"\]\(([^)#\s:]*)(?:#([^)]*))?\)", CODE.sub("", page.read_text())
    ):
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), path
        if anchor:
            headings = re.findall(r"^#+ (.*)$", CODE.sub("", target.read_text()), re.M)
            assert anchor in {slug(heading) for heading in headings}, f"{path}#{anchor}"


def test_the_functions_that_the_architecture_lists_exist():
    page = (ROOT / "docs" / "architecture.md").read_text()
    file = ""
    functions = 0
    for path, name in re.findall(r"^(\S+/\S*)? +(?:(?:[A-Z]\w+)\.)?(\w+) {2,}\S.*$", page, re.M):
        file = path or file
        if file:
            source = ROOT / file
            texts = [
                part.read_text() for part in (source.glob("*.py") if source.is_dir() else [source])
            ]
            assert any(re.search(rf"^\s*(?:def|class) {name}\b", text, re.M) for text in texts), (
                file,
                name,
            )
            functions += 1
    assert functions >= 20


def glossary():
    """Text of each term."""
    page = (ROOT / "docs" / "glossary.md").read_text()
    return {
        term.lower(): text.strip()
        for term, text in re.findall(r"^## ([^\n]*)\n(.*?)(?=^## |\Z)", page, re.M | re.S)
    }


def test_glossary_has_the_terms_of_task_and_training():
    terms = glossary()
    assert list(terms) == sorted(terms)
    assert {"actor", "bundle", "clean", "constraint set", "exam", "held", "learner"} <= terms.keys()
    assert {"policy", "rollout", "staleness", "student", "success"} <= terms.keys()
    for constraint in CONSTRAINTS:
        assert constraint.title in terms


@pytest.mark.parametrize(("term", "text"), glossary().items())
def test_a_term_is_explained_in_few_sentences(term, text):
    sentences = re.findall(r"[.:?](?:\s|$)", text)
    assert text, term
    assert len(sentences) <= 3, term


def test_pages_link_to_the_glossary():
    linked = set()
    for page in PAGES:
        linked.update(re.findall(r"\]\([^)\s]*glossary\.md#([\w-]+)\)", page.read_text()))
    anchors = {slug(term) for term in glossary()}
    assert linked
    assert linked <= anchors
