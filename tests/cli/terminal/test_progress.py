"""Progress messages of long commands."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from cosim.cli.progress import doing
from cosim.core.units import duration


def test_a_log_gets_one_line_for_each_stage() -> None:
    """Where standard error is no terminal, each stage prints one line when it begins."""
    output = io.StringIO()
    with doing("reading [the] city", Console(file=output, width=80)) as tell:
        for share in (0.0, 0.5, 1.0):
            tell("simulating to 20 s", share)
        tell("drawing")
    assert output.getvalue() == "reading [the] city ...\nsimulating to 20 s ...\ndrawing ...\n"


def test_a_terminal_gets_a_progress_line_that_is_erased() -> None:
    """The line shows the stage with its share and time, and is erased at the end."""
    output = io.StringIO()
    console = Console(
        file=output, width=80, force_terminal=True, legacy_windows=False, _environ={"TERM": "xterm"}
    )
    with doing("reading [the] city", console) as tell:
        tell("simulating to 20 s", 0.5)
    assert "simulating to 20 s: 50 %" in output.getvalue() and "0:00:00" in output.getvalue()
    assert output.getvalue().endswith("\x1b[2K") or "\x1b[1A\x1b[2K" in output.getvalue()


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.2, "0 s"),
        (59.4, "59 s"),
        (74.0, "70 s"),
        (116.0, "2 min"),
        (3570.0, "1 h"),
        (4000.0, "1 h 7 min"),
        (23400.0, "6 h 30 min"),
    ],
    ids=lambda value: str(value).replace(" ", "-"),
)
def test_a_remaining_time_is_rounded_to_its_precision(seconds: float, words: str) -> None:
    """It is rounded to seconds, tens of seconds, minutes, or tens of minutes: below one, two, 120
    minutes, and above."""
    assert duration(seconds) == words
