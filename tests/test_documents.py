"""README and docs/: every example is accepted or runs as written, and every link leads to a file or
heading."""

from __future__ import annotations

import re
import runpy
import tomllib
from functools import lru_cache
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest
import yaml
from typer.main import get_command

import cosim
from cosim.cli.app import app
from cosim.policies import POLICIES
from cosim.policies.load import WEIGHTED_POLICIES, shipped_bundles
from cosim.spec.connection import checked_endpoint
from cosim.spec.goal import GoalProtocol
from cosim.spec.robot import ROBOTS
from scenarios.events import EVENT_KINDS
from scenarios.suites.catalog import SUITES
from scenarios.suites.user_scenarios.read import read_own
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import ROOT, Cosim
from tests.support.documents import PAGES, Block, blocks, shell_lines, text_of

RUN_ELSEWHERE = {
    "from policy_server import serve": "scenarios/test_remote.py",
    "import json, zenoh": "bridge/test_live_examples.py",
}
"""Beginnings of Python blocks that need a run to connect to, and the tests that run them as written."""
COMMANDS: Any = get_command(app)
CHEAP = (
    "list ",
    "suite list ",
    "map list ",
    "certs ",
    "scenario new ",
    "scenario check ",
    "scenario draw ",
    "look night.toml ",
)
"""Commands that are run, as they take a second or two; the others are parsed."""
PYTHON = [block for block in blocks("python") if not block.text.startswith(tuple(RUN_ELSEWHERE))]
POLICY = re.compile(r"^class (\w+):\n    manifest = ", re.MULTILINE)


def parsed(words: list[str]) -> dict[str, Any]:
    """Return the parameters of a command line without `cosim`, parsed and not run."""
    command = COMMANDS
    words = list(words)
    while hasattr(command, "commands"):
        command = command.commands[words.pop(0)]
    parameters: dict[str, Any] = command.make_context(command.name, words).params
    return parameters


@lru_cache
def ids_of(suite: str) -> set[str]:
    """Return the ids of the scenarios of a suite."""
    return {scenario.id for scenario in cosim.load_suite(suite).scenarios}


def unknown_names(parameters: dict[str, Any]) -> list[object]:
    """Return unknown names in parameters: of policies, suites, scenarios, events, robots, goals.
    Raises an error for an invalid endpoint."""
    policies = {*POLICIES, *shipped_bundles(), *WEIGHTED_POLICIES}
    named: dict[str, set[str]] = {
        "policy": policies,
        "learner": policies,
        "suite": {*SUITES},
        "event": {*EVENT_KINDS, "static"},
        "robot": {*ROBOTS},
        "goal": {*get_args(GoalProtocol)},
        "split": {"val", "test"},
    }
    wrong: list[object] = []
    for key, valid in named.items():
        given = parameters.get(key) or ()
        for name in given.split(",") if isinstance(given, str) else given:
            free = key in ("policy", "learner", "suite") and (
                ":" in name or name.endswith((".toml", ".json"))
            )
            wrong += [] if free or name in valid else [name]
    suite = parameters.get("suite")
    if suite in SUITES:
        wrong += [name for name in parameters.get("scenario") or () if name not in ids_of(suite)]
    for key in ("listen", "connect", "live", "director", "policy_at"):
        given = parameters.get(key) or ()
        for endpoint in (given,) if isinstance(given, str) else given:
            checked_endpoint(endpoint, key)
    return wrong


@pytest.mark.parametrize("page", PAGES)
def test_the_command_line_accepts_every_command(page: str) -> None:
    """Each `cosim` line of a page has existing commands, options, values of their types, policies,
    suites and events."""
    for where, words in shell_lines(page):
        if words[0] in ("cosim", "taskset"):
            assert not unknown_names(parsed(words[words.index("cosim") + 1 :])), where


@pytest.mark.parametrize("page", PAGES)
def test_other_commands_name_existing_targets_and_files(page: str) -> None:
    """Make targets, extras, modules and scripts in shell blocks exist, and no other program is
    called."""
    makefile = (ROOT / "Makefile").read_text()
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    for where, words in shell_lines(page):
        match words:
            case ["make", target]:
                assert f"\n{target}:" in makefile, where
            case ["pip", "install", *packages]:
                for extra in re.findall(r"\.\[(\w+)\]", " ".join(packages)):
                    assert extra in extras, where
            case ["python", "-m", module, *_]:
                assert find_spec(module), where
            case ["cosim" | "podman" | "apt-get" | "source" | "export" | "taskset", *_]:
                pass
            case _:
                assert (ROOT / words[0]).is_file(), where


@pytest.mark.parametrize("page", PAGES)
def test_commands_in_the_text_exist(page: str) -> None:
    """Commands in backticks, such as `cosim score`, and their options exist."""
    for words in (found.split() for found in re.findall(r"`cosim ([a-z][^`]*)`", text_of(page))):
        command: Any = COMMANDS
        while hasattr(command, "commands") and words:
            command = command.commands[words.pop(0).rstrip(",")]
        options = {option for parameter in command.params for option in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= options, words


@pytest.mark.engine
def test_cheap_commands_run_as_written(tmp_path: Path, cosim: Cosim) -> None:
    """Lists, certificates and scenario files, one at night: each command succeeds, in the order of
    the pages."""
    (night,) = (block for block in blocks("toml", "docs/scenarios.md") if "[light]" in block.text)
    (tmp_path / "night.toml").write_text(night.text)
    ran = 0
    for words, where in {tuple(words): where for where, words in shell_lines()}.items():
        if (
            words[0] == "cosim"
            and f"{' '.join(words[1:])} ".startswith(CHEAP)
            and "--drive" not in words
        ):
            done = cosim(*words[1:], cwd=tmp_path)
            assert done.returncode == 0, (where, done.stderr)
            ran += 1
    assert ran >= 12


@pytest.mark.engine
@pytest.mark.parametrize("block", PYTHON, ids=lambda block: block.name)
def test_python_runs_as_written(
    block: Block,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Each Python block runs as a script, prints what its comments behind `print` promise, and its
    policies drive."""
    monkeypatch.chdir(tmp_path)
    script = tmp_path / f"example_{block.line}_{Path(block.page).stem}.py"
    script.write_text(block.text)
    runpy.run_path(str(script), run_name="__main__")
    printed = capsys.readouterr().out
    for promised in re.findall(r"^ *print\(.*\)  # (.*)$", block.text, re.MULTILINE):
        assert promised in printed
    for name in POLICY.findall(block.text):
        assert_drives(f"{script}:{name}")


def assert_drives(policy: str) -> None:
    """Assert that a policy answers throughout a short episode."""
    loaded = cosim.load_policy(policy)
    scenario = msgspec.structs.replace(small_scenario(), time_limit_s=1.0)
    with cosim.Episode(scenario, loaded.manifest) as episode:
        loaded.reset(episode.id, episode.seed)
        observation = episode.reset()
        while not episode.over:
            observation = episode.advance(loaded.act(observation))
    assert episode.result()[0].ended == "timeout"


def test_python_that_needs_a_run_is_run_elsewhere() -> None:
    """The other blocks are those of the table, and the named test reads their page."""
    others = [block for block in blocks("python") if block not in PYTHON]
    assert len(others) == len(RUN_ELSEWHERE)
    for block in others:
        (test,) = (path for begin, path in RUN_ELSEWHERE.items() if block.text.startswith(begin))
        assert block.page in (ROOT / "tests" / test).read_text()


@pytest.mark.parametrize("block", blocks("toml"), ids=lambda block: block.name)
def test_scenario_files_can_be_read(block: Block, tmp_path: Path) -> None:
    """Each TOML block is a valid scenario file."""
    (tmp_path / "mine.toml").write_text(block.text)
    assert read_own(tmp_path / "mine.toml").variants


def test_every_block_has_a_language_that_is_tested() -> None:
    """Pages have only blocks that a test reads, and output and citations as text."""
    for page in PAGES:
        languages = re.findall(r"^```(.*)\n(?:.*\n)*?```$", text_of(page), re.MULTILINE)
        assert {*languages} <= {
            *("bash", "python", "toml", "json", "xml", "text", "bibtex", "{eval-rst}")
        }, page
        assert not re.search(
            r"\n\n    \S", re.sub(r"^```.*?^```$", "", text_of(page), flags=re.M | re.S)
        ), page
    assert {block.page for block in blocks("json")} == {
        "docs/onnx.md",
        "docs/robots.md",
        "docs/scans.md",
        "docs/trust.md",
    }


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as MyST and GitHub make them."""
    headings = re.findall(
        r"^#+ (.*)$", re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S), re.MULTILINE
    )
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [*PAGES, "ARCHITECTURE.md", "CONTRIBUTING.md"])
def test_links_lead_to_files_and_headings(page: str) -> None:
    """Relative links of documents name existing files, and headings in them."""
    path = ROOT / page
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text()):
        if not target.startswith("https://"):
            name, _, heading = target.partition("#")
            linked = path.parent / name if name else path
            assert linked.exists(), target
            assert not heading or heading in anchors(linked.read_text()), target


def test_the_readme_is_short_and_links_every_page() -> None:
    """It has at most 150 lines and links each page of docs/, as does the site's table of
    contents."""
    assert len(text_of("README.md").splitlines()) <= 150
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")}
    assert len(pages) <= 20
    assert {*re.findall(r"\(docs/([\w-]+)\.md\)", text_of("README.md"))} == pages
    contents = (ROOT / "docs" / "index.rst").read_text()
    assert sorted(re.findall(r"^   ([\w-]+)$", contents, re.MULTILINE)) == sorted(pages)


def test_the_citation_is_of_this_version_and_names_the_paper() -> None:
    """`CITATION.cff` has the project's version and licence, and the paper with all authors that the
    README names."""
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (cited["version"], cited["license"]) == (project["version"], project["license"])
    (paper,) = cited["references"]
    names = " and ".join(
        f"{author['family-names']}, {author['given-names']}" for author in paper["authors"]
    )
    assert names in text_of("README.md") and paper["title"] in text_of("README.md")


def test_the_results_of_the_readme_are_those_of_the_baselines() -> None:
    """Each figure with an interval is in a row of the same policy on the page of all results. It
    may be in the row of D below it."""
    rows = [
        line.strip("| ").split(" | ")
        for line in text_of("README.md").splitlines()
        if re.search(r"^\| `.*\| (camera|lidar, route|people) \|", line)
    ]
    page = text_of("docs/baselines.md").splitlines()
    results = text_of("README.md").partition("## Results")[2].partition("## ")[0]
    assert len(rows) == 9 and len(re.findall(r"^\| `", results, re.MULTILINE)) == 13
    for words, sees, *figures in rows:
        name = words.partition("` ")[0].partition("`,")[0].partition("`;")[0].strip("`")
        tested = [
            line + below
            for line, below in pairwise(page)
            if line.startswith(f"| `{name}`, {sees.partition(',')[0]}") and "(" in line
        ]
        measured = [figure for figure in figures if "(" in figure]
        assert measured, name
        assert all(any(f"| {figure} |" in line for line in tested) for figure in measured), name
