"""Valid content of a suite file: everything else is refused with every fault before anything runs."""

from __future__ import annotations

import json
import math
import os
import re
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import pytest

from cosim.core.errors import SpecError
from cosim.spec.scenario import City, Scenario, Suite, read_suite
from scenarios.events import EVENT_KINDS
from scenarios.suites.catalog import SUITES, load_suite
from tests.support.mutate_suites import mutated, outcomes, small_suite

PLACE = re.compile(r"`\$[\w.\[\]]*`|line \d+, byte \d+ of it|`scenarios` needs|nested too deep")
"""Pattern of the place in the file that a refusal names."""


def valid_suite() -> dict[str, Any]:
    """The file of a suite of three: a long way with barriers, crossings and events, and two short
    ones with groups."""
    chosen = [s for s in load_suite("long-horizon").scenarios if s.id == "lh-037-00"]
    chosen += [
        s
        for s in load_suite("reactive").scenarios
        if s.id in ("ped_crossing-001", "conversing-001")
    ]
    return json.loads(
        msgspec.json.encode(Suite(name="sound", version="1", scenarios=tuple(chosen)))
    )  # type: ignore[no-any-return]


def refusal(path: Path, data: bytes | str) -> str:
    """Return the refusal of a file with this content, without the file's name."""
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    with pytest.raises(SpecError) as caught:
        read_suite(path, EVENT_KINDS)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


def test_a_thousand_mutated_suites_are_read_or_refused_with_reasons(tmp_path: Path) -> None:
    """Any file is a suite, or has a short refusal of printable lines that each name their place."""
    suite = valid_suite()
    path = tmp_path / "mutated.json"
    accepted = 0
    for seed in range(1000):
        path.write_bytes(mutated(suite, seed))
        try:
            read_suite(path, EVENT_KINDS)
            accepted += 1
        except SpecError as error:
            message = str(error).removeprefix(f"{path}: ")
            lines = message.splitlines()
            assert len(lines) <= 6 and all(
                line.isprintable() and len(line) <= 500 for line in lines
            ), (seed, message)
            faults = lines[1:] if len(lines) > 1 else lines
            assert all(PLACE.search(line) for line in faults), (seed, message)
    assert 100 < accepted < 600


@pytest.mark.engine
def test_mutated_suites_that_are_accepted_can_be_driven(tmp_path: Path) -> None:
    """Eight that reader and map accept are driven for 2 s without a crash (`python -m
    tests.support.mutate_suites`: 200)."""
    driven = []
    for outcome in outcomes(small_suite(City(seed=1, size_m=500.0)), tmp_path, count(0)):
        if outcome.what == "does not fit its place":
            assert all(
                line.isprintable() and len(line) <= 500 for line in outcome.words.splitlines()
            ), outcome
        elif outcome.what != "refused":
            driven.append(outcome)
        if len(driven) == 8:
            break
    assert [outcome.what for outcome in driven] == ["driven"] * 8, driven


OUT_OF_RANGE: tuple[tuple[tuple[str | int, ...], object, str], ...] = (
    (
        ("name",),
        "../../x",
        "name '../../x' cannot name a suite, and the folder of a run: use 1 to 100 of A-Z",
    ),
    (("first", "id"), "a\nb", r"id 'a\nb' cannot name a folder"),
    (("first", "seed"), -1, "seed must be in [0, 4294967295], not -1 - at `$.scenarios[0]`"),
    (("first", "seed"), 10**30, "seed must be in [0, 4294967295], not 1e+30"),
    (
        ("first", "place", "size_m"),
        1.5,
        "city size_m must be in [200, 4000], not 1.5 - at `$.scenarios[0].place",
    ),
    (
        ("first", "place", "size_m"),
        300.001,
        "city size_m must be in whole centimetres, not 300.001",
    ),
    (("first", "place", "style"), "../x", "city style '../x' cannot name a style"),
    (("first", "place", "seed"), -1, "city seed must be in [0, 4294967295], not -1"),
    (
        ("first", "place", "kind"),
        "moon",
        "Invalid value 'moon' - at `$.scenarios[0].place`. Valid choices: city,",
    ),
    (("first", "goal_radius_m"), 1e9, "goal_radius_m must be in [0.1, 20], not 1000000000.0"),
    (("first", "time_limit_s"), 1e-9, "time_limit_s must be in [0.1, 100000], not 1e-09"),
    (("first", "route", 3, 0), math.nan, "route[3][0] must be in [-10000000, 10000000], not nan"),
    (("first", "start", 2), math.inf, "start's heading must be in [-6.28319, 6.28319], not inf"),
    (
        ("first", "barriers", 1, "length_m"),
        9e18,
        "barrier length_m must be in [0.1, 200], not 9e+18",
    ),
    (
        ("first", "barriers", 0, "x_m"),
        -math.inf,
        "barrier x_m must be in [-10000000, 10000000], not -inf",
    ),
    (
        ("first", "barriers", 0, "strip"),
        "s\x1b[2J",
        r"barrier strip must be at most 200 letters and no control",
    ),
    (("first", "crossings", 0, "leave_s_m"), 0.0, "comes after leave_s_m 0.0"),
    (
        ("first", "crossings", 0, "leave_s_m"),
        9e3,
        "leave_s_m is 9000, but the route ends at 303.168",
    ),
    (("first", "events", 0, "route_s_m"), 9e3, "route_s_m is 9000, but the route ends at 303.168"),
    (
        ("first", "events", 0, "half_width_m"),
        1e9,
        "half_width_m must be in (0.3, 50], not 1000000000.0",
    ),
    (
        ("first", "events", 0, "id"),
        "e <x>",
        "event id 'e <x>': ids of event pedestrians start with 'e'",
    ),
    (
        ("first", "events", 0, "kind"),
        "ambush",
        "Invalid enum value 'ambush' - at `$.scenarios[0].events[0].kind`. V",
    ),
    (
        ("first", "events", 0, "people"),
        2,
        "people of 'obstructing' must be 1, not 2 - at `$.scenarios[0].events[0]`",
    ),
    (
        ("first", "events", 0, "half_length_m"),
        2.0,
        "half_length_m is the crosswalk's: of 'ped_crossing', and of no",
    ),
    (("first", "crowd", "persons"), 10**9, "crowd persons must be in [0, 1000], not 1000000000"),
    (("first", "crowd", "vehicles"), 10**9, "crowd vehicles must be in [0, 200], not 1000000000"),
    (
        ("first", "light", "hour"),
        math.nan,
        "light hour must be in [0, 24], not nan - at `$.scenarios[0].light`",
    ),
    (("first", "ends_at"), "stop", "ends_at 'stop' needs an event 'gesturing'"),
)
"""Where in the file (`first`: in its first scenario), its value, and the expected message."""


@pytest.mark.parametrize(
    ("where", "value", "expected"),
    OUT_OF_RANGE,
    ids=[".".join(map(str, where)) for where, _, _ in OUT_OF_RANGE],
)
def test_a_value_out_of_its_range_is_named(
    tmp_path: Path, where: tuple[str | int, ...], value: object, expected: str
) -> None:
    """The message has field, range and value, also for numbers that JSON lacks, such as NaN."""
    suite: Any = valid_suite()
    *holders, key = where
    holder = suite
    for step in holders:
        holder = holder["scenarios"][0] if step == "first" else holder[step]
    holder[key] = value
    assert expected in refusal(tmp_path / "s.json", json.dumps(suite))


def test_several_faults_are_reported_at_once(tmp_path: Path) -> None:
    """Wrong types, unknown fields and contradictions have one line each, at most five."""
    suite = valid_suite()
    first, second, third = suite["scenarios"]
    first |= {"seed": "x", "gaol": 1, "crowd": {"persons": -1, "groups": 2.0}, "goal_radius_m": 1e9}
    second["goal"] = [0.0, 0.0]
    assert refusal(tmp_path / "s.json", json.dumps(suite)).splitlines() == [
        "5 faults:",
        "  Object contains unknown field `gaol` - at `$.scenarios[0]`. Valid choices: "
        + ", ".join(Scenario.__struct_fields__)
        + ". Did you mean goal?",
        "  Expected `int`, got `str` - at `$.scenarios[0].seed`",
        "  crowd persons must be in [0, 1000], not -1; crowd groups must be a share in [0, 1], "
        "not 2.0 - at `$.scenarios[0].crowd`",
        "  goal_radius_m must be in [0.1, 20], not 1000000000.0 - at `$.scenarios[0]`",
        f"  scenario '{second['id']}': goal (0.0, 0.0) is not the route's end "
        f"{tuple(second['route'][-1])} - at `$.scenarios[1]`",
    ]
    third["route"] = [["x", "y"]] * 2000
    lines = refusal(tmp_path / "s.json", json.dumps(suite)).splitlines()
    assert lines[0] == "1000 faults or more; the first 5:" and len(lines) == 6


def test_a_file_that_is_no_json_is_refused_with_the_place(tmp_path: Path) -> None:
    """A file that is cut off, not UTF-8, or nested endlessly is refused with line and byte, or the
    general fault."""
    text = json.dumps(valid_suite(), indent=1).encode()
    expected = {
        text[: text.index(b'"version"')]: "JSON ends too early, line 3, byte 1 of it",
        text.replace(
            b'"version"', b",", 1
        ): "JSON is malformed: object keys must be strings, line 3, byte 1 of it",
        text.replace(b'"version"', b'"ver\xffsion"', 1): "is no UTF-8 text, line 3, byte 5 of it",
        b"[" * 100_000: "is nested too deep",
        b"": "JSON ends too early, line 1, byte 0 of it",
        b"[]": "Expected `object`, got `array`",
    }
    for data, words in expected.items():
        assert refusal(tmp_path / "s.json", data).startswith(words)
    (tmp_path / "s.json").write_bytes(b"\xef\xbb\xbf" + text)
    assert read_suite(tmp_path / "s.json").name == "sound"


def test_a_path_that_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    """A folder, a pipe without a writer and a missing file cause no wait and no endless read."""
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "folder.json").mkdir()
    for name, words in (
        ("pipe.json", "is no file"),
        ("folder.json", "is no file"),
        ("none.json", "cannot be read: No such file or directory"),
    ):
        with pytest.raises(SpecError, match=f"{name}: {words}"):
            read_suite(tmp_path / name)


def test_a_repeated_scenario_is_found_in_linear_time(
    tmp_path: Path,
) -> None:
    """Of 300 ids hardly any two are compared, so that 48,000 take no longer than their reading."""

    class Counting(str):
        compared = 0

        def __eq__(self, other: object) -> bool:
            Counting.compared += 1
            return str.__eq__(self, other)

        __hash__ = str.__hash__

    one = load_suite("reactive").scenarios[0]
    scenarios = tuple(
        msgspec.structs.replace(one, id=Counting(f"s-{i}")) for i in [*range(300), 41]
    )
    with pytest.raises(SpecError, match="suite 'big' lists scenarios twice: s-41"):
        Suite(name="big", version="1", scenarios=scenarios)
    assert Counting.compared < 300


@pytest.mark.parametrize("name", SUITES)
def test_the_shipped_suites_keep_their_ranges(name: str) -> None:
    """They are read without a fault."""
    assert load_suite(name).scenarios
