"""`cosim verify`: the shipped values match the shipped suites, and every planted difference is
found and named."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from cosim.core.errors import RunError
from cosim.core.state import Frame
from scenarios.suites.catalog import SUITES, load_suite
from scenarios.tools.verify import engines
from scenarios.tools.verify import shipped as shipped_values
from scenarios.tools.verify.cases import verified_cases
from scenarios.tools.verify.engines import DRIVER, TOP_FOLDERS, source_hashes, textures
from scenarios.tools.verify.shipped import SHIPPED, Results, trace_of, writable
from scenarios.tools.verify.traces import Trace, kept_picture, traced
from scenarios.tools.verify.verdict import BLAMES, blamed, findings, first_difference
from sumo_nets.crowd import shown_people
from tests.conftest import ROOT, Cosim

REMADE = "the suites were built anew: `cosim verify --write`"
replace = msgspec.structs.replace


@pytest.fixture(scope="module")
def shipped() -> Results:
    return Results.load(SHIPPED)


def test_shipped_values_match_the_shipped_suites(shipped: Results) -> None:
    """There are twelve cases, each with both pictures; `scans` has no structure of its own."""
    assert shipped.suites == {name: load_suite(name).content_hash for name in SUITES}, REMADE
    cases = verified_cases()
    assert [case.id for case in cases] == [*shipped.traces] and len(cases) == 12, REMADE
    assert {case.suite for case in cases} == {*SUITES} - {"scans"}
    kinds = [case.structure for case in cases]
    assert len({*kinds}) == 12 and {"straight", "frontal", "gesturing", "route"} < {*kinds}
    for trace in shipped.traces.values():
        assert isinstance(trace, Trace) and {*trace.pictures} == {"bullet", "gl"}
    assert writable(shipped, [case.id for case in cases]) is shipped


def test_shipped_values_were_made_by_these_sources(shipped: Results) -> None:
    """Otherwise a difference would be attributed to an unedited source."""
    here = source_hashes()
    other = [
        room for room in {*here, *shipped.sources} if here.get(room) != shipped.sources.get(room)
    ]
    assert not other, (
        "the source has changed: see that `cosim verify` finds the same bits, then `cosim "
        "verify --write`"
    )


def test_a_difference_is_blamed_on_packages_that_exist() -> None:
    """Every package that a blame names has a source hash, so an edited one is found."""
    assert {source for blame in BLAMES.values() for source in blame.sources} <= {*source_hashes()}


def differences(shipped: Results, here: Results) -> tuple[list[str], str]:
    """Return the names of differing findings, and their messages."""
    wrong = [one for one in findings(shipped, here) if not one.fine]
    words = [f"{one.name}: {one.words}" for one in wrong]
    return [one.name for one in wrong], "\n".join([*words, *blamed(wrong, shipped, here)])


def changed_at(trace: Trace, part: str, tick: int) -> Trace:
    """Return a trace in which a part and all later parts differ from a tick on."""
    at = 3 * (tick + 1)
    other = "".join("0" if digit != "0" else "1" for digit in trace.ticks[part][at:])
    later = {name: digits[: at + 3] + "fff" for name, digits in trace.ticks.items()}
    return replace(trace, ticks=later | {part: trace.ticks[part][:at] + other}, state_hash="other")


def with_trace(given: Results, case: str, change: Callable[[Trace], Trace | str]) -> Results:
    trace = given.traces[case]
    assert isinstance(trace, Trace)
    return replace(given, traces=given.traces | {case: change(trace)})


def test_the_shipped_installation_has_no_differences(shipped: Results) -> None:
    """Compared with itself nothing differs, and there is a line for every case."""
    assert differences(shipped, shipped) == ([], "")
    assert {*shipped.traces} < {one.name for one in findings(shipped, shipped)}


PLANTED: dict[str, tuple[Callable[[Results], Results], list[str], tuple[str, ...]]] = {
    "package": (
        lambda g: replace(g, versions=g.versions | {"numpy": "9.9"}),
        ["package numpy"],
        ("9.9 here", "pip install --require-hashes -r requirements.lock"),
    ),
    "suite": (
        lambda g: replace(g, suites=g.suites | {"unit": "0"}),
        ["suite unit"],
        ("it was edited. Take it as it was shipped",),
    ),
    "engine": (
        lambda g: replace(
            with_trace(g, "lh-001-00", lambda t: changed_at(t, "crowd", 7)),
            alone=g.alone | {"SUMO": "0"},
        ),
        ["SUMO alone", "lh-001-00"],
        (
            "the engine itself",
            "the crowd first, at 0.35 s",
            "SUMO alone gives something else, too. Remedy: pip",
        ),
    ),
    "crowd": (
        lambda g: replace(
            with_trace(g, "lh-001-00", lambda t: changed_at(t, "crowd", 7)),
            sources=g.sources | {"sumo_nets/crowd": "0"},
        ),
        ["lh-001-00"],
        (
            "the crowd first, at 0.35 s; what follows hangs on it",
            "SUMO alone gives what it should, so it is ours; the source of sumo_nets/crowd "
            "is not the shipped one",
            "Remedy: take the source as it was shipped",
        ),
    ),
    "people": (
        lambda g: with_trace(g, "frontal-001", lambda t: changed_at(t, "events", 40)),
        ["frontal-001"],
        (
            "our event pedestrians first, at 2.00 s",
            "something changes scenarios/events, cosim/people",
        ),
    ),
    "policy": (
        lambda g: with_trace(g, "lateral-001", lambda t: changed_at(t, "policy", 0)),
        ["lateral-001"],
        ("the policy first, at 0.00 s",),
    ),
    "physics": (
        lambda g: with_trace(g, "curve-001", lambda t: changed_at(t, "robot", -1)),
        ["curve-001"],
        ("the robot's physics first, before it begins", "PyBullet alone gives what it should"),
    ),
    "metrics": (
        lambda g: with_trace(
            g, "curve-001", lambda t: replace(t, measures=t.measures | {"spl": 0.123})
        ),
        ["curve-001"],
        ("the same to the bit, but not measured so: spl", "the metrics: "),
    ),
    "texture": (
        lambda g: replace(
            g,
            textures=g.textures | {"ground asphalt": "0"},
            sources=g.sources | {"physics/textures": "0"},
        ),
        ["textures"],
        ("differ: ground asphalt", "the source of physics/textures is not the shipped one"),
    ),
    "crash": (
        lambda g: with_trace(g, "curve-001", lambda _: "SUMO failed while starting"),
        ["curve-001"],
        ("cannot be run: SUMO failed while starting",),
    ),
}


@pytest.mark.parametrize("plant, names, words", PLANTED.values(), ids=PLANTED)
def test_a_planted_difference_is_named_with_its_remedy(
    shipped: Results, plant: Callable[[Results], Results], names: list[str], words: tuple[str, ...]
) -> None:
    """Nothing else differs, and the message names the engine, version or part."""
    found, message = differences(shipped, plant(shipped))
    assert found == names
    for word in words:
        assert word in message


def picture(level: int) -> Frame:
    labels = np.zeros((96, 96), np.uint8)
    labels[48:] = 1
    return Frame(np.full((96, 96, 3), level, np.uint8), labels)


@pytest.mark.parametrize(
    "level, driver, fine",
    [
        (100, "shipped", True),
        (101, "shipped", False),
        (103, "another", True),
        (140, "another", False),
    ],
    ids=[
        "same",
        "same driver, a level off",
        "another driver, three levels off",
        "another driver, forty levels off",
    ],
)
def test_pictures_of_another_driver_may_differ_a_little(
    shipped: Results, level: int, driver: str, fine: bool
) -> None:
    """With the shipped driver they must be equal to the bit."""

    def with_picture(given: Results, level: int) -> Results:
        one = kept_picture(picture(level))
        return with_trace(
            given, "curve-001", lambda t: replace(t, pictures=t.pictures | {"gl": one})
        )

    before = with_picture(shipped, 100)
    after = with_picture(shipped, level)
    if driver == "another":
        after = replace(after, alone=after.alone | {DRIVER: "0"}, renderer="gl: other")
    found, message = differences(before, after)
    assert found == ([] if fine else ["curve-001"])
    assert fine or "its picture by gl is not: 100.00 % of the labels" in message


def test_a_changed_texture_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """One changed texel changes this texture and no other."""
    stack = engines.ground_layers(256)
    spoiled = stack.rgba.copy()
    spoiled[stack.index("asphalt"), 3, 5, 0] ^= 1
    layers = type(stack)(stack.names, spoiled, stack.metres, stack.mean, stack.finish)

    def ground_layers(size_px: int) -> Any:
        return layers

    before = textures()
    monkeypatch.setattr(engines, "_STACKS", (ground_layers, *engines._STACKS[1:]))
    assert {name for name, digest in textures().items() if before[name] != digest} == {
        "ground asphalt"
    }


def test_an_edited_source_changes_the_hash_of_its_package(tmp_path: Path) -> None:
    """In a copy of the tree an edited constant changes this hash and no other."""
    for room in TOP_FOLDERS:
        shutil.copytree(
            ROOT / room, tmp_path / room, ignore=shutil.ignore_patterns("__pycache__", "*.json")
        )
    before = source_hashes(tmp_path)
    edited = tmp_path / "sumo_nets" / "crowd" / "shown_people.py"
    edited.write_text(edited.read_text().replace("MAX_SPEED_MPS = 2.2", "MAX_SPEED_MPS = 2.1"))
    after = source_hashes(tmp_path)
    assert before == source_hashes(ROOT)
    assert {room for room in before if before[room] != after[room]} == {"sumo_nets/crowd"}


@pytest.mark.parametrize(
    "content", [b"", b"{}", b'{"schema": 1'], ids=["empty", "of nothing", "cut short"]
)
def test_damaged_values_are_named(tmp_path: Path, content: bytes) -> None:
    """One line names the file and the remedy."""
    (tmp_path / "verify.json").write_bytes(content)
    with pytest.raises(
        RunError, match=r"verify\.json: holds nothing to verify by: .*\. Install again$"
    ):
        Results.load(tmp_path / "verify.json")


def test_an_error_of_a_case_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors of other packages are reported as well."""

    def traced(case: object) -> Trace:
        raise AttributeError("module 'numpy' has no attribute 'frob'")

    monkeypatch.setattr(shipped_values, "traced", traced)
    assert trace_of(verified_cases()[0]) == "AttributeError: module 'numpy' has no attribute 'frob'"


def test_an_unknown_case_is_refused(cosim: Cosim) -> None:
    """The message suggests a valid name."""
    done = cosim("verify", "--case", "frontal-01")
    assert done.returncode == 2 and "Did you mean frontal-001?" in done.stderr


@pytest.mark.engine
def test_this_installation_is_verified(cosim: Cosim) -> None:
    """One case of each suite verifies engines alone, textures, bits, numbers and pictures."""
    names = ("crosswalk-001", "lateral-001", "lh-001-00")
    done = cosim("verify", "--jobs", "1", *(word for name in names for word in ("--case", name)))
    assert done.returncode == 0, done.stdout + done.stderr
    for name in ("SUMO alone", "PyBullet alone", "TinyRenderer alone", *names):
        assert f"ok      {name}: " in done.stdout
    assert "This installation gives the shipped bits and numbers." in done.stdout


@pytest.mark.engine
def test_a_changed_constant_of_the_crowd_is_found(
    monkeypatch: pytest.MonkeyPatch, shipped: Results
) -> None:
    """The crowd differs first, before all that depends on it."""
    (case,) = [case for case in verified_cases() if case.id == "lh-001-00"]
    monkeypatch.setattr(shown_people, "MAX_SPEED_MPS", 1.2)
    trace = traced(replace(case, time_limit_s=1.0))
    expected = shipped.traces[case.id]
    assert isinstance(expected, Trace) and first_difference(expected, trace)[0] == "crowd"
