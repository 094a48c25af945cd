"""Tables of the command line, in a terminal of 80 columns."""

from __future__ import annotations

import io

import pandas as pd
import pytest
from rich.console import Console

from cosim.cli_tables import COUNTS, SHOWN, print_scenarios, print_table
from cosim.errors import unknown
from scenarios.catalog import SUITES, suite


def terminal() -> tuple[Console, io.StringIO]:
    said = io.StringIO()
    return Console(file=said, width=80), said


@pytest.mark.parametrize("name", SUITES)
def test_the_scenarios_of_a_suite_fit_80_columns(name: str) -> None:
    """No name and no number is cut, and every scenario has a line with its place."""
    out, said = terminal()
    print_scenarios(out, suite(name))
    assert "…" not in said.getvalue()
    for scenario in suite(name).scenarios:
        assert f" {scenario.id} " in said.getvalue() and f" {scenario.place.name} " in said.getvalue()


def test_a_bad_run_fits_80_columns() -> None:
    """The longest shipped name, two digits before every point, and dozens of failures: nothing is cut."""
    row = {"scenario": "ped_crossing-001", "status": "done", "ended": "timeout", "reason": ""}
    row |= {name: 34.56 for name, _ in SHOWN} | {name: 120 for name, _ in COUNTS}  # type: ignore[dict-item]
    out, said = terminal()
    print_table(out, pd.DataFrame([row]), 1)
    assert "…" not in said.getvalue()
    assert "ped_crossing-001 timeout" in said.getvalue() and "120/120/120" in said.getvalue()


def test_of_many_valid_names_the_likely_ones_are_listed() -> None:
    """A hundred and sixty scenarios are no answer to a slip of the pen: five are, and how many there are."""
    names = [scenario.id for scenario in suite("reactive").scenarios]
    assert "frontal-001" in str(unknown("scenario", "frontal-0001", names))
    assert len(str(unknown("scenario", "x", names))) < 160 and "Valid choices: 160" in str(
        unknown("scenario", "x", names)
    )
