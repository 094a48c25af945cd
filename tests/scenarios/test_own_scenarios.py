"""Users' scenarios in TOML files: valid fields, results, and every refusal."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from cosim.core.errors import SpecError
from cosim.spec.robot import COURIER, ROBOTS
from cosim.spec.scenario import City, Scenario
from scenarios.suites.user_scenarios.along_route import event_along
from scenarios.suites.user_scenarios.format import OwnEvent, OwnScenario, OwnWay
from scenarios.suites.user_scenarios.read import read_own
from scenarios.suites.user_scenarios.routes import build_way
from tests.conftest import ROOT, Cosim
from tests.support.documents import blocks
from tests.support.tiny_street import tiny_map

CITY = "[place]\ncity = 1\nsize_m = 500\n"
SHORT = f'name = "short"\n{CITY}[way]\nkind = "straight"\nlength_m = 30\n'
TEMPLATE = ROOT / "scenarios" / "suites" / "user_scenarios" / "template.toml"


def written(folder: Path, text: str) -> Path:
    path = folder / "own.toml"
    path.write_text(text)
    return path


def refusal(folder: Path, text: str) -> str:
    path = written(folder, text)
    with pytest.raises(SpecError) as refused:
        read_own(path)
    assert str(refused.value).startswith(f"{path}: ")
    return str(refused.value).removeprefix(f"{path}: ")


def test_all_faults_of_a_file_are_reported_at_once(tmp_path: Path) -> None:
    """Types, ranges, names and contradictions are reported with the field, the value and the valid
    choices."""
    message = refusal(
        tmp_path,
        'name = "a b"\nseed = "x"\nrobot = "tank"\nsizes = 1\n'
        '[place]\ncity = 1\nmap = "berlin-11"\n[way]\nkind = "strait"\nlenght_m = 40\n'
        '[[events]]\nkind = "fronal"\nat_m = "far"\n[[events]]\npeople = 0\n'
        '[crowd]\ngroups = 2\n[light]\nhour = 25\n[limits]\nends_at = "noon"\n',
    )
    head, *faults = message.splitlines()
    assert head == f"{len(faults)} faults:"
    for fault in (
        "unknown field `sizes`. Valid choices: name, description, seed, seeds, robot,",
        "name 'a b' cannot name a scenario: use 1 to 100 of",
        "seed: must be a whole number, not 'x'",
        f"robot: unknown robot 'tank'. Valid choices: {', '.join(sorted(ROBOTS))}.",
        "place: give one of city, map, file, not city and map",
        "place.map: unknown map 'berlin-11'. Valid choices: ",
        "way: unknown field `lenght_m`. Valid choices: kind, length_m, start, goal, route, "
        "fences, signals. Did you mean length_m?",
        "way.kind: Invalid enum value 'strait'. Valid choices: straight, curve, crosswalk, route. "
        "Did you mean straight?",
        "events[0].kind: unknown event 'fronal'. ",
        "events[0].at_m: must be a number, not 'far'",
        "events[1]: there is no `kind`",
        "events[1]: people must be in [1, 100], not 0",
        "crowd groups must be a share in [0, 1], not 2.0",
        "light hour must be in [0, 24], not 25.0",
        "limits.ends_at: Invalid enum value 'noon'. Valid choices: goal, stop",
    ):
        assert sum(line.strip().startswith(fault) for line in faults) == 1, fault
    assert len(faults) == 15


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[", "is no TOML: "),
        ('name = "a"\nname = "b"', "is no TOML: Cannot overwrite a value (at end"),
        ("", "3 faults:\n  there is no `name`\n  there is no `place`\n  there is no `way`"),
        (f'name = "n"\n{CITY}[way]\n', "way: give one of kind, start and goal, route, not none"),
        (
            f'name = "n"\n{CITY}[way]\nstart = [1, 2]\n',
            "way: start and goal go together; goal is missing",
        ),
        (
            f'name = "n"\n{CITY}[way]\nstart = [1, 2, 3]\ngoal = [1, 2]',
            "way.start: must be a list of 2 values, not [1",
        ),
        (
            f'name = "n"\n{CITY}[way]\nkind = "curve"\nlength_m = 20\n',
            "way length_m is for ways of kind 'straight'",
        ),
        (
            SHORT.replace("30", "300"),
            "way length_m of kind 'straight' must be in [10, 100], not 300",
        ),
        (
            SHORT.replace('"short"', '"unit"'),
            "name 'unit' is that of a suite that ships: choose another",
        ),
        (
            SHORT + "[crowd]\npersons = 3\ndensity = 2.0\n",
            "crowd: give persons (3) or density (2), not both",
        ),
        (
            SHORT + "[crowd]\ndensity = [0, 900]\n",
            "crowd density must be in [0, 150] per 1000 m2, not 900.0",
        ),
        (
            SHORT + "[crowd]\ndensity = []\n",
            "crowd.density is an empty list: give values to sweep over",
        ),
        (
            SHORT + "[crowd]\ndensity = [nan]\n",
            "crowd density must be in [0, 150] per 1000 m2, not nan",
        ),
        (
            "seeds = 1000\n" + SHORT + "[light]\nhour = [8, 9, 10, 11, 12, 13]\n",
            "makes 6000 scenarios, and at most 5000 can be had: give fewer values or seeds",
        ),
        (
            f'name = "n"\n{CITY}[way]\nroute = [[1, 2], [1, 2]]\n',
            "way route needs two different points or more",
        ),
        (
            f'name = "n"\n{CITY}[way]\nstart = [nan, 2]\ngoal = [1, 2]',
            "way start[0] must be in [-10000000, 10000000]",
        ),
        (
            f'name = "n"\n{CITY}[way]\nlength_m = 20\n',
            "way: give one of kind, start and goal, route, not none",
        ),
        (
            'name = "n"\n[place]\nfile = "\\u0000"\n[way]\nkind = "curve"\n',
            "place file must be at most 1000 letters",
        ),
        ("seeds = [1, 2]\n" + SHORT, "seeds: must be a whole number, not [1, 2]"),
    ],
    ids=[
        "syntax",
        "twice",
        "empty",
        "no-way",
        "no-goal",
        "three-numbers",
        "no-length",
        "too-long",
        "name-of-a-suite",
        "both",
        "one-value",
        "no-value",
        "no-number",
        "too-many",
        "one-point",
        "nan",
        "length-of-none",
        "control-character",
        "list-of-seeds",
    ],
)
def test_a_single_fault_is_refused_with_its_remedy(tmp_path: Path, text: str, message: str) -> None:
    """One fault of an otherwise valid file gives one message."""
    assert refusal(tmp_path, text).startswith(message)


def test_files_that_are_no_text_are_refused(tmp_path: Path) -> None:
    """Invalid bytes, a folder, a missing file, a large file and endless brackets give one line
    each."""
    path = tmp_path / "own.toml"
    for data, message in (
        (b'name = "\xff"', "is no UTF-8 text, line 1"),
        (b"#" * 1_000_001, "holds more than 1000000 bytes"),
        (b"a = " + b"[" * 100_000, "is n"),
    ):
        path.write_bytes(data)
        with pytest.raises(SpecError, match=message):
            read_own(path)
    for missing, message in (
        (tmp_path, "is no file"),
        (tmp_path / "b.toml", "`cosim scenario new .*b.toml` writes one"),
    ):
        with pytest.raises(SpecError, match=message):
            read_own(missing)


def test_a_list_in_place_of_a_value_is_a_sweep(tmp_path: Path) -> None:
    """Each value is combined with each other one and each seed; points and fields of single events
    can be swept as well."""
    text = (
        f'name = "s"\nseed = 7\nseeds = 2\n{CITY}[way]\nstart = [120, 131]\ngoal = [[345, '
        f"300], [250, 240]]\n"
        '[[events]]\nkind = "frontal"\nspeed_mps = [1.1, 1.5]\n[crowd]\ndensity = [0, 2.5]\n'
    )
    own = read_own(written(tmp_path, text))
    assert [axis.field for axis in own.axes] == ["way.goal", "events[0].speed_mps", "crowd.density"]
    assert len(own.variants) == 16 == len({variant.id for variant in own.variants})
    first, second, *_, last = own.variants
    assert (first.id, second.id) == (
        "s-goal345_300-speed_mps1.1-density0-s7",
        "s-goal345_300-speed_mps1.1-density0-s8",
    )
    assert (
        first.own.crowd.spec.empty
        and last.own.crowd.density == 2.5
        and last.own.events[0].speed_mps == 1.5
    )
    assert last.own.way.goal == (250.0, 240.0) and last.own.seed == 8
    assert last.at == {"way.goal": [250, 240], "events[0].speed_mps": 1.5, "crowd.density": 2.5}


def test_the_template_shows_every_field() -> None:
    """Every field of a scenario file is in the template, except three rare ones."""
    lines = [line.removeprefix("# ") for line in TEMPLATE.read_text().splitlines()]
    shown = {line.split(" ")[0] for line in lines}

    def fields(kind: Any) -> set[str]:
        found = set()
        for field in msgspec.structs.fields(kind):
            inner = [field.type, *getattr(field.type, "__args__", ())]
            tables = [
                one for one in inner if isinstance(one, type) and issubclass(one, msgspec.Struct)
            ]
            found |= {field.name} if not tables else set().union(*map(fields, tables))
        return found

    assert fields(OwnScenario) - shown == {"shadows", "hdri", "paint"}


def test_the_file_in_the_documents_can_be_read(tmp_path: Path) -> None:
    """The documented file is a sweep over density on a map file beside it."""
    own = read_own(written(tmp_path, blocks("toml", "docs/scenarios.md")[0].text))
    assert [axis.field for axis in own.axes] == ["crowd.density"]
    assert Path(own.variants[0].own.place.file).parent == tmp_path


def on_tiny(**way: Any) -> Scenario:
    return build_way(OwnWay(**way), City(seed=1), tiny_map(), 0, COURIER)


def test_the_way_between_two_points_leads_over_the_crossing() -> None:
    """It leads from the middle of the nearest sidewalk to that of the other, over the crossing that
    joins them."""
    over = on_tiny(start=(-40.0, 6.0), goal=(30.0, -7.0))
    assert over.start[:2] == (-40.0, 5.0) and over.goal == (30.0, -6.5)
    assert [(crossing.id, crossing.signalised) for crossing in over.crossings] == [(":c0", False)]
    assert over.route_line.length_m == pytest.approx(40 + 30 + 11.5, abs=4.0)
    along = on_tiny(start=(-40.0, 5.0), goal=(-10.0, 5.0))
    assert not along.crossings and along.route_line.length_m == pytest.approx(30.0)
    given = on_tiny(route=((0.0, 5.0), (0.0, -6.0)))
    assert [crossing.id for crossing in given.crossings] == [":c0"]


@pytest.mark.parametrize(
    ("way", "message"),
    [
        (
            {"start": (-40, 30), "goal": (30, 5)},
            r"way.start \(-40, 30\) is 24 m from the near.*\(-40.0, 5.0\)",
        ),
        ({"start": (-40, 5), "goal": (-40.2, 5)}, "start and goal are on one spot"),
        (
            {"start": (-40, 5), "goal": (30, 5), "signals": "with"},
            "way signals 'with': it leads over 0 cross",
        ),
    ],
    ids=["far", "one-spot", "no-signals"],
)
def test_an_impossible_way_is_refused(way: dict[str, Any], message: str) -> None:
    """The message says what was found at the place."""
    with pytest.raises(SpecError, match=message):
        on_tiny(**way)


def test_an_event_that_does_not_fit_is_refused_with_places_that_do() -> None:
    """The message has the reason, and the stretches of the way where the event fits."""
    street = tiny_map()
    over = on_tiny(start=(-60.0, 5.0), goal=(60.0, -6.5))

    def at(kind: str, at_m: float | None) -> Any:
        return event_along(0, OwnEvent(kind=kind, at_m=at_m), over, street, COURIER)

    for kind, at_m, message in (
        (
            "frontal",
            5.0,
            "before the robot is there, 21 m from the start or farther; it fits from 21 to ",
        ),
        ("frontal", 63.0, "no sidewalk is there, but a corner or a crossing"),
        ("frontal", 900.0, "the way ends at "),
        (
            "conversing",
            30.0,
            "is 3.0 m wide there, and it needs 3.9 m; it fits nowhere on this way",
        ),
        ("ped_crossing", 10.0, "at_m 10 is on no crossing for 'ped_crossing': it fits from 6"),
    ):
        with pytest.raises(SpecError) as error:
            at(kind, at_m)
        assert message in str(error.value), error.value
    crossing = at("ped_crossing", None)
    frontal = at("frontal", 30.0)
    assert np.hypot(crossing.x_m, crossing.y_m) < 2.0 and crossing.half_length_m > 2.0
    assert (frontal.x_m, frontal.y_m, frontal.heading_rad, frontal.half_width_m) == (
        -30.0,
        5.0,
        0.0,
        1.5,
    )
    middle = at("obstructing", None)
    assert abs(middle.route_s_m - over.route_line.length_m / 2) < 12.0


@pytest.mark.engine
def test_a_new_file_can_be_checked_drawn_and_run(tmp_path: Path, cosim: Cosim) -> None:
    """`new`, `check`, `draw` and `run` lead to pictures and a table, with latency, and an existing
    file is not overwritten."""
    done = cosim("scenario", "new", "mine.toml", cwd=tmp_path)
    assert done.returncode == 0 and (tmp_path / "mine.toml").read_text().count('name = "mine"') == 1
    again, done = (
        cosim("scenario", *words, cwd=tmp_path)
        for words in (("new", "mine.toml"), ("check", "mine.toml"))
    )
    assert again.returncode == 2 and "is there already" in again.stderr
    assert (
        done.returncode == 0 and "mine.toml: 1 scenario" in done.stdout and " 40.0 " in done.stdout
    ), done.stderr
    for words in (
        ("-o", "way.png"),
        ("--whole", "-o", "town.png"),
        ("--zoom", "0,0,90,60", "-o", "part.png"),
    ):
        done = cosim("scenario", "draw", "mine.toml", *words, cwd=tmp_path)
        assert done.returncode == 0 and (tmp_path / words[-1]).read_bytes().startswith(
            b"\x89PNG"
        ), done.stderr
    done = cosim(
        "scenario", "draw", "mine.toml", "--zoom", "900,900,990,990", "-o", "far.png", cwd=tmp_path
    )
    assert (
        done.returncode == 2
        and "shows nothing of the place" in done.stderr
        and not (tmp_path / "far.png").exists()
    )
    text = (tmp_path / "mine.toml").read_text()
    (tmp_path / "mine.toml").write_text(text.replace("# time_s = 260", "time_s = 1"))
    words = (
        "scenario",
        "run",
        "mine.toml",
        "--policy",
        "schedule:stand",
        "--latency",
        "100",
        "--out",
        "run",
    )
    done = cosim(*words, cwd=tmp_path)
    assert done.returncode == 0 and "Run folder: run" in done.stdout, done.stderr
    assert "latency 100 ms: commands take effect so much later" in done.stdout


@pytest.mark.engine
def test_misfits_of_all_files_are_reported(tmp_path: Path, cosim: Cosim) -> None:
    """Events and obstacles that do not fit are named with their place in the file, and valid files
    are reported as well."""
    (tmp_path / "sound.toml").write_text(SHORT)
    (tmp_path / "odd.toml").write_text(
        SHORT + '[[events]]\nkind = "frontal"\nat_m = 2\n[[events]]\nkind = "ped_crossing"\n'
        '[[obstacles.placed]]\nkind = "bin"\nat_m = 99\n'
    )
    (tmp_path / "blocked.toml").write_text(
        SHORT + '[[obstacles.placed]]\nkind = "bin"\nat_m = 0.3\n[[events]]\nkind = '
        '"queueing"\npeople = 9\n[light]\nhdri = "none.hdr"\n'
    )
    fences = (
        f'[[obstacles.placed]]\nkind = "fence"\nat_m = 15\nturned_deg = 90\nleft_m = {m}\n'
        for m in (-0.9, 0.9)
    )
    (tmp_path / "narrow.toml").write_text(SHORT + "".join(fences))
    files = ("odd.toml", "sound.toml", "blocked.toml", "narrow.toml")
    done = cosim("scenario", "check", *files, cwd=tmp_path)
    assert done.returncode == 2 and "sound.toml: 1 scenario" in done.stdout
    for message in (
        "odd.toml: events[0]: at_m 2 does not do for 'frontal'",
        "odd.toml: events[1]: 'ped_crossing' needs a crossing without signals",
        "odd.toml: obstacles.placed[0]: at_m 99 is past the goal: the way is 30.0 m long",
        "blocked.toml: obstacles[0] (bin) stands where the robot starts",
        "none.hdr' does not exist",
        "narrow.toml: its obstacles leave no gap of ",
        "blocked.toml: event 'e0': people of 'queueing' must be 2 to 5, not 9",
    ):
        assert message in done.stderr, done.stderr
    drawn = cosim("scenario", "draw", "odd.toml", "-o", "odd.png", cwd=tmp_path)
    assert (
        drawn.returncode == 2
        and (tmp_path / "odd.png").exists()
        and "events[0]: at_m 2 does not" in drawn.stderr
    )


@pytest.mark.engine
def test_check_drive_solves_scenarios_with_the_oracle(tmp_path: Path, cosim: Cosim) -> None:
    """`check --drive` gives the time of the oracle, or its failure with exit code 1."""
    near = SHORT.replace("length_m = 30", "length_m = 10")
    (tmp_path / "near.toml").write_text(near)
    (tmp_path / "hasty.toml").write_text(near + "[limits]\ntime_s = 2\n")
    solved, hasty = (
        cosim("scenario", "check", name, "--drive", cwd=tmp_path)
        for name in ("near.toml", "hasty.toml")
    )
    assert solved.returncode == 0 and "short: solved by orca in " in solved.stdout, solved.stderr
    assert hasty.returncode == 1 and "short: orca fails: ended by time" in hasty.stdout, (
        hasty.stderr
    )


SECRET = "hunter2-SECRET"
OTHERS: dict[str, bytes] = {
    "text": f"{SECRET}:x:0:0".encode(),
    "binary": b"\xfe\xff" + SECRET.encode(),
    "json": b'{"key": "%s"}' % SECRET.encode(),
    "toml": f'hunter2 = "{SECRET}"'.encode(),
    "xml": f"<config><password>{SECRET}</password></config>".encode(),
    "root": f"<{SECRET}/>".encode(),
    "name space": f"<n:{SECRET} xmlns:n='{SECRET}'/>".encode(),
    "entity": f"<!DOCTYPE {SECRET} [<!ENTITY {SECRET} '{SECRET}'>]><osm/>".encode(),
    "encoding": f"<?xml version='1.0' encoding='{SECRET}'?><osm/>".encode(),
    "cut XML": f"<html><title>{SECRET}</title>".encode(),
    "packed": gzip.compress(SECRET.encode()),
    "PBF": f"OSMHeader{SECRET}".encode(),
}


@pytest.mark.parametrize(
    ("name", "ending"),
    [
        *((name, "") for name in OTHERS),
        ("text", ".net.xml"),
        ("xml", ".net.xml"),
        ("packed", ".osm"),
    ],
)
def test_the_content_of_a_file_that_is_no_map_is_not_printed(
    tmp_path: Path, cosim: Cosim, name: str, ending: str
) -> None:
    """Text, other XML and packed data are refused with the path of the file and none of its
    bytes."""
    (tmp_path / f"other{ending}").write_bytes(OTHERS[name])
    own = f'name = "mine"\n[place]\nfile = "other{ending}"\n[way]\nkind = "straight"\n'
    (tmp_path / "mine.toml").write_text(own)
    done = cosim("scenario", "check", "mine.toml", cwd=tmp_path)
    assert done.returncode == 2 and f"place.file: {tmp_path}/other{ending}: " in done.stderr, done
    assert "hunter2" not in done.stderr + done.stdout and "Traceback" not in done.stderr, done
