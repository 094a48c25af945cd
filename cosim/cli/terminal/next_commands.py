"""Print what can be done with a run: the commands, with its folder."""

from __future__ import annotations

import shlex
from pathlib import Path

import pandas as pd
from rich.console import Console


def print_next_commands(err: Console, folder: Path, table: pd.DataFrame) -> None:
    """Print the commands that show a run: a film, of a failure where there is one; a page; one episode.

    table: a row per episode. A run of which no episode came to its end has neither film nor picture.
    """
    run, ended = shlex.quote(str(folder)), table[table["ended"].notna()]
    lines = [f"cosim report {run} -o report.html"]
    if len(ended):
        failed = ended[ended["success"] == 0.0]
        first = shlex.quote(str((failed if len(failed) else ended)["scenario"].iloc[0]))
        shown = "--failure" if len(failed) else first
        lines = [f"cosim film {run} {shown} -o film.mp4", *lines, f"cosim show {run} --episode {first}"]
    err.print("\n  ".join(["Next:", *lines]), soft_wrap=True, highlight=False, markup=False)
