"""Tables in terminals of any width: figures are never cut."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console

from cosim.cli import tables
from cosim.cli.bench import print_figures
from cosim.cli.results import print_comparison, print_sheet
from cosim.cli.run_table import COUNTS, SHOWN, WITH_PEOPLE, print_by_kind, print_table
from cosim.cli.scenario import _print_sweep
from cosim.cli.suites import print_scenarios
from cosim.results.compare import DIFFERENCES, FLIPPED, ComparedRun, RunComparison
from cosim.results.intervals import Estimate
from cosim.results.metrics import COUNTERFACTUAL, METRICS
from cosim.results.table import COLUMNS as KEYS
from cosim.spec.scenario import Suite
from scenarios.suites.catalog import load_suite
from scenarios.suites.user_scenarios.sweep import SWEPT
from scenarios.tools.bench.figures import Figure
from scenarios.tools.viewing.event_sheet import COLUMNS
from tests.conftest import ROOT

WIDTHS = (60, 80, 120)
LONG = "sumo-fokr-bs-demo-ped_crossing-003"
"""A name as long as those of episodes on maps."""


def episodes() -> pd.DataFrame:
    """Twelve successful episodes and their decoys with long names, large figures, dozens of
    failures, and the robot's cost."""
    row = dict.fromkeys((*KEYS, *METRICS, *COUNTERFACTUAL), 34.56) | {
        name: 120.0 for name, _ in COUNTS
    }
    row |= {name: 34.56 for name, _ in (*SHOWN, *WITH_PEOPLE)}
    row |= {name: 1.0 for name, metric in METRICS.items() if metric.share}
    words = {
        "status": "done",
        "ended": "timeout",
        "reason": "",
        "camera": "none",
        "nonstandard": "",
        "weather": "clear",
    }
    words |= {
        "policy": "p",
        "goal_protocol": "none",
        "odometry": "none",
        "waypoints": "w",
        "policy_runs": "in-process",
    }
    return pd.DataFrame(
        [
            row
            | words
            | {
                "scenario": f"{LONG}{i:x}{end}",
                "split": ("val", "test")[i % 2],
                "decoy_of": f"{LONG}{i:x}" * bool(end),
            }
            for i in range(12)
            for end in ("", "-decoy")
        ]
    )


def example_run(out: Console) -> None:
    table = episodes()
    print_table(out, table, 24)
    kinds = [kind for kind in ("ped_crossing", "conversing") * 6 for _ in range(2)]
    print_by_kind(out, table, dict(zip(table["scenario"], kinds, strict=True)))


def example_comparison(out: Console) -> None:
    figures = (200, -34.567, 34.567, "", "", 69.134, -12.345, 81.479, 100, "within noise")
    rows = [
        ("a", "b", by, LONG, name, "", *figures) for by in ("suite", "event") for name in METRICS
    ]
    before, after = (ComparedRun(label, Path(label), episodes()) for label in "ab")
    tables_of_differences = (
        pd.DataFrame(rows, columns=list(DIFFERENCES)),
        pd.DataFrame([], columns=list(FLIPPED)),
    )
    print_comparison(out, RunComparison("reactive", before, (after,), *tables_of_differences, ()))


def example_sheet(out: Console) -> None:
    row = (LONG, "ped_crossing", -19.86, -19.98, 0.123, 0.060, 34.56, 34.56, -12.34, -180.0, 12.34)
    print_sheet(out, pd.DataFrame([row], columns=list(COLUMNS)))


def example_sweep(out: Console) -> None:
    rows = [
        {
            "crowd.density": 12.5,
            "events.kind": "ped_crossing",
            "obstacles.per_100m": 3.5,
            "crashed": 3,
            "metric": name,
        }
        | Estimate(34.56, -34.56, 34.56, 200)._asdict()
        for name in SWEPT
    ]
    _print_sweep(pd.DataFrame(rows), ["crowd.density", "events.kind", "obstacles.per_100m"])


def example_figures(out: Console) -> None:
    print_figures(
        {
            f"a policy's answer to {LONG}, ms": [
                Figure("f", 1234.56, limit=1034.56, limit_is="SUMO", reach=34.56)
            ]
            * 3
        }
    )


def example_suite(out: Console) -> None:
    print_scenarios(
        out, Suite(name="s", version="1", scenarios=load_suite("long-horizon").scenarios[-3:])
    )


TABLES: dict[str, tuple[Callable[[Console], None], Sequence[str]]] = {
    "run": (example_run, ("34.56", "120/120/120/120", "34.56 to 34.56", "0.61..1.00")),
    "comparison": (
        example_comparison,
        ("-34.57", "34.57", "+69.13", "-12.35 to +81.48", "200", "within noise"),
    ),
    "events": (example_sheet, ("-19.98", "0.123", "0.060", "-12.34", "-180", "12.34")),
    "sweep": (example_sweep, ("34.56", "-34.56..34.56", "200")),
    "bench": (example_figures, ("1235", "1035", "1235 to 1235", "<= 34.56")),
    "suite": (example_suite, ("lh-braunschweig-2", "1750")),
}


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", TABLES)
def test_no_figure_is_cut(name: str, width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a narrow, a usual and a wide terminal lines fit, no cell ends in dots, and figures are
    complete."""
    output = io.StringIO()
    out = Console(file=output, width=width)
    for module in ("scenario", "bench"):
        monkeypatch.setattr(f"cosim.cli.{module}.out", out)
    prints, figures = TABLES[name]
    prints(out)
    text = output.getvalue()
    in_tables = [line for line in text.splitlines() if not line.startswith("Paired by scenario")]
    assert "…" not in text and max(map(len, in_tables)) <= width, text
    for figure in figures:
        assert re.search(rf"(?<!\S){re.escape(figure)}(?!\S)", text), text


def test_a_table_that_is_too_wide_is_divided() -> None:
    """Each part repeats the names and holds as many figures as fit; every figure appears once, in
    column order."""
    heads = [f"figure {k}" for k in range(9)]
    output = io.StringIO()
    row = (LONG, *(f"{k}.000000" for k in range(9)))
    tables.show(
        Console(file=output, width=50), [*tables.names("what"), *tables.figures(*heads)], [row]
    )
    parts = output.getvalue().split("what")[1:]
    assert len(parts) > 1 and max(map(len, output.getvalue().splitlines())) <= 50
    found = [[word for word in part.split() if word.endswith(".000000")] for part in parts]
    assert [word for words in found for word in words] == [f"{k}.000000" for k in range(9)] and all(
        found
    )


def test_a_table_that_fits_is_unchanged() -> None:
    """Headings are broken only where they do not fit."""
    columns = [*tables.names("what"), *tables.figures("a head of several words")]
    wide, narrow = io.StringIO(), io.StringIO()
    for file, width in ((wide, 40), (narrow, 20)):
        tables.show(Console(file=file, width=width), columns, [("a", "1.00")])
    assert "a head of several words" in wide.getvalue() and "several" in narrow.getvalue().split()


def test_cells_are_plain_text() -> None:
    """Brackets in a name are no markup, a section is separated, and title and note surround the
    table."""
    output = io.StringIO()
    columns = [*tables.names("what"), *tables.labels("how"), *tables.words("why")]
    rows = [("a [1]", "b", "c"), None, ("d", "e", "f")]
    tables.show(Console(file=output, width=40), columns, rows, title="above", note="below")
    lines = [line.split() for line in output.getvalue().splitlines()]
    assert lines[0] == ["above"] and lines[-1] == ["below"]
    assert ["a", "[1]", "b", "c"] in lines and ["d", "e", "f"] in lines


def test_every_command_prints_tables_through_one_module() -> None:
    """No other module of the command line builds a table."""
    modules = sorted((ROOT / "cosim/cli").rglob("*.py"))
    builders = [path.name for path in modules if "rich.table" in path.read_text()]
    assert builders == ["tables.py"]
