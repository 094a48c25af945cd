"""Tables of the command line, in a terminal of 80 columns."""

from __future__ import annotations

import dataclasses
import io
import re
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console

from cosim.cli.run_table import (
    COUNTS,
    LETTERS,
    SHOWN,
    WITH_PEOPLE,
    print_by_kind,
    print_next_commands,
    print_table,
    print_terms,
)
from cosim.cli.suites import print_names
from cosim.core.errors import unknown
from cosim.results.metrics import METRICS, SUCCESS_IN_WORDS
from cosim.results.table import table_of
from scenarios.events import EVENT_KINDS
from scenarios.suites.catalog import load_suite
from tests.support.documents import text_of
from tests.support.driven_runs import episode_of, short_way


def terminal(width: int = 80) -> tuple[Console, io.StringIO]:
    output = io.StringIO()
    return Console(file=output, width=width), output


def pair_of_kinds() -> tuple[pd.DataFrame, dict[str, str]]:
    """Two short episodes of two events with a collision each: 1 in the episode, 8.48 in 100 m."""
    row = dict.fromkeys(METRICS, 1.0) | {"status": "done", "ended": "failure", "reason": ""}
    row |= {name: 0.25 for name, _ in (*SHOWN, *COUNTS, *WITH_PEOPLE)}  # type: ignore[dict-item]
    row |= {"collisions": 1.0, "collisions_per_100m": 8.48}  # type: ignore[dict-item]
    names = ("ped_crossing-001", "frontal-001")
    return pd.DataFrame([row | {"scenario": n} for n in names]), {
        n: n.rsplit("-", 1)[0] for n in names
    }


def test_a_letter_means_one_thing_in_every_table() -> None:
    """C, OL and F are per 100 m in every table; other counts have names in words."""
    table, kinds = pair_of_kinds()
    episodes, shares = terminal(), terminal()
    print_table(episodes[0], table, 2)
    print_by_kind(shares[0], table, kinds)
    assert "8.48" in episodes[1].getvalue() and "C/OL/F" not in episodes[1].getvalue()
    heads = shares[1].getvalue().split("ped_crossing")[0].split()
    assert "person" in heads and not {"RC", "FC", "C", "OL", "F", "V"} & set(heads)


def test_every_letter_and_heading_is_explained_under_its_table() -> None:
    """Letters are explained below the table, and rates have their unit in the heading, as in the
    documents."""
    table, kinds = pair_of_kinds()
    out, output = terminal()
    print_table(out, table, 2)
    text = " ".join(output.getvalue().split())
    page = " ".join(text_of("docs/baselines.md").split())
    for _, letter in SHOWN:
        assert f"{letter} {LETTERS[letter]}" in text, letter
    for letter in ("C", "OL", "F"):
        assert f"{letter} {LETTERS[letter]}" in page.replace("`", ""), letter
    assert text.count("/100m") >= 4 and "m/s" in text
    out, output = terminal()
    print_by_kind(out, table, kinds)
    assert "share of these" in " ".join(output.getvalue().split())


def test_tables_of_success_name_events_with_their_own_ending() -> None:
    """Below every table with SR the events that need a stop, and those that need passing round, are
    named."""
    out, output = terminal()
    print_table(out, pair_of_kinds()[0], 2)
    assert SUCCESS_IN_WORDS in " ".join(output.getvalue().split())
    stop, rule = SUCCESS_IN_WORDS.split("(")[1:]
    assert all(kind.name in stop for kind in EVENT_KINDS.values() if kind.ends_at == "stop")
    assert all(kind.name in rule for kind in EVENT_KINDS.values() if kind.passed_as_group)
    assert sum(kind.name in SUCCESS_IN_WORDS for kind in EVENT_KINDS.values()) == sum(
        kind.ends_at == "stop" or kind.passed_as_group for kind in EVENT_KINDS.values()
    )


def test_a_misspelt_name_gets_a_few_similar_ones() -> None:
    """A misspelt scenario name gets five similar ones and the total count, not all 1,700."""
    names = [scenario.id for scenario in load_suite("reactive").scenarios]
    assert "frontal-001" in str(unknown("scenario", "frontal-0001", names))
    assert len(str(unknown("scenario", "x", names))) < 160 and "Valid choices: 1700" in str(
        unknown("scenario", "x", names)
    )


def test_val_and_test_have_separate_rows() -> None:
    """A run with both has a row for each, with its crashes, and counts below five episodes; other
    runs have none."""
    rows = [
        dict.fromkeys(METRICS, 1.0)
        | {
            "scenario": f"s-{i}",
            "status": "crashed" if i == 2 else "done",
            "reason": "",
            "ended": "goal",
            "split": split,
            "success": float(split == "val" and i != 2),
        }
        for i, split in enumerate(("val",) * 6 + ("test",) * 3)
    ]
    out, output = terminal()
    print_table(out, pd.DataFrame(rows), 9)
    assert re.search(r"^ +val +6 +1 +0\.83 0\.44\.\.0\.97 ", output.getvalue(), re.MULTILINE)
    assert re.search(r"^ +test +3 +0 +0/3 +1\.00 +3 in 3 m ", output.getvalue(), re.MULTILINE)
    assert "…" not in output.getvalue()
    out, output = terminal()
    print_table(out, pd.DataFrame(rows[:2]), 2)
    assert "split" not in output.getvalue()


def test_a_table_lists_the_setup_and_marks_nonstandard_policies() -> None:
    """Camera, rate, goals, waypoint rule and seed are below the rows; a policy with its own camera
    has a star and the reason."""
    row = {
        "scenario": "s-1",
        "status": "done",
        "ended": "goal",
        "reason": "",
        "camera": "own mount, 64 x 64 px, 75 deg",
    }
    row |= {"goal_protocol": "route_point", "odometry": "gps", "privileged": True}  # type: ignore[dict-item]
    row |= {
        "policy": "orca",
        "rate_hz": 4.0,
        "waypoints": "waypoint 2, units of 1 m, in 0.25 s, shipped",
        "run_seed": 7,
        "policy_runs": "in-process",
        "track": "privileged",
        **dict.fromkeys(("lidar", "imu", "people"), "none"),
    }  # type: ignore[dict-item]
    row = dict.fromkeys(METRICS, 1.0) | {name: 1.0 for name, _ in (*SHOWN, *COUNTS)} | row  # type: ignore[assignment]
    for odd, star in (("a camera of its own", True), ("", False)):
        out, output = terminal()
        print_table(out, pd.DataFrame([row | {"nonstandard": odd}]), 1)
        text = " ".join(output.getvalue().split())
        assert (
            "policy orca (oracle, privileged); sensor track privileged; camera own mount, "
            "64 x 64 px, 75 deg, at 4 Hz; goal route_point; "
            "odometry gps; waypoint 2, units of 1 m, in 0.25 s, shipped; seed 7" in text
        )
        assert (
            ("s-1*" in text)
            is ("* nonstandard, not to be compared: a camera of its own" in text)
            is star
        )


def test_a_table_omits_cameras_and_waypoints_that_a_policy_lacks(
    tmp_path: Path,
) -> None:
    """A blind policy has no camera in its line; the waypoint rule appears only if an answer had
    waypoints."""
    record, log = episode_of(short_way("s-0"), "h")
    assert log is not None
    plan = {
        "plan_sizes": np.ones(1, np.int32),
        "plan_points": np.ones((1, 2), np.float32),
        "plan_index": 0,
    }
    for name, expected in (
        ("commands", log),
        ("waypoints", dataclasses.replace(log, answers=np.ones((1, 4)), **plan)),
    ):
        (tmp_path / name / "episodes/s-0").mkdir(parents=True)
        (tmp_path / name / "episodes/s-0/trajectory.npz").write_bytes(expected.encoded())
        out, output = terminal()
        print_terms(out, table_of([record]), tmp_path / name)
        text = " ".join(output.getvalue().split())
        assert (
            text.startswith("policy p; sensor track blind; at 4 Hz; goal none; odometry none; ")
            and "camera" not in text
        )
        assert ("waypoint 2, units of 1 m" in text) is (name == "waypoints")


def test_the_list_marks_privileged_policies() -> None:
    """`orca` is the oracle; it and three other baselines are privileged, those that see are not."""
    out, output = terminal()
    print_names(out)
    named = [
        line.split("  ")[1] for line in output.getvalue().splitlines() if line.startswith("policy ")
    ]
    privileged = [
        "route (privileged)",
        "orca (oracle, privileged)",
        "orca-hasty (privileged)",
        "social_force (privileged)",
    ]
    assert [name for name in named if "privileged" in name] == privileged
    assert {"stop", "straight", "nav", "small"} <= {*named}


def test_the_next_commands_are_printed_with_the_runs_folder() -> None:
    """Next are a film of the first failure, or of any episode, a report and one episode; without
    trajectories a report."""

    def printed_lines(*rows: tuple[str, str | None, float]) -> list[str]:
        output = io.StringIO()
        table = pd.DataFrame(rows, columns=["scenario", "ended", "success"])
        print_next_commands(Console(file=output, width=40), Path("runs/my run"), table)
        assert output.getvalue().endswith("\n")
        return [line.strip() for line in output.getvalue().splitlines()]

    report = "cosim report 'runs/my run' -o report.html"
    assert printed_lines(("a", "goal", 1.0), ("b", "failure", 0.0)) == [
        "Next:",
        "cosim film 'runs/my run' --failure -o film.mp4",
        report,
        "cosim show 'runs/my run' --episode b",
    ]
    assert printed_lines(("a", "goal", 1.0))[1] == "cosim film 'runs/my run' a -o film.mp4"
    assert printed_lines(("a", None, 0.0)) == ["Next:", report]


def test_few_episodes_are_counted_and_crashes_have_a_column() -> None:
    """One episode gives no interval and failures in metres; a kind with a crash has its count, and
    no count of people hit."""
    ways = [short_way(f"s-{k}", structure=("straight", "curve")[k % 2]) for k in range(4)]

    def printed_table(*hows: str) -> str:
        records = [episode_of(way, "h", how)[0] for way, how in zip(ways, hows, strict=False)]
        out, output = terminal()
        print_table(out, table_of(records), len(records))
        print_by_kind(out, table_of(records), {way.id: way.structure for way in ways})
        return output.getvalue()

    one = printed_table("goal")
    assert re.search(r"success \(SR\) +1/1 +- +1 ", one)
    assert re.search(r"collisions_per_100m \(C\) +0 in 8 m +- +1 ", one)
    assert re.search(r"velocity_mean_mps \(V\) +1\.00 +- +1 ", one)
    assert not re.search(r"\d to \d|\d\.\.\d", one) and "crash " not in one
    several = printed_table("goal", "goal", "goal", "crashed")
    assert re.search(r"success \(SR\) +3/4 +- +4 ", several)
    assert re.search(r"velocity_mean_mps \(V\) +0\.75 ", several)
    assert re.search(r"failures_per_100m \(FC\) +- +- +0 ", several)
    assert re.search(r"straight +2 +0 +2/2 +- +1\.00 +0/2 ", several)
    assert re.search(r"curve +2 +1 +1/2 +- +0\.50 +- +- ", several)
    assert "- unknown, because an episode crashed" in " ".join(several.split())
