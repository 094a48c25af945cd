"""The commands `cosim doctor`, `cosim verify` and `cosim cache`."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Annotated

import typer
from rich.markup import escape

from cosim.cli import tables
from cosim.cli.console import err, notice, out
from cosim.cli.progress import doing
from cosim.core.cache import (
    CACHE_KINDS,
    GB,
    LIMIT_VARIABLE,
    UNUSED_S,
    CacheEntry,
    cache_entries,
    cache_folder,
    cache_limit_bytes,
    clean_up,
)
from cosim.core.errors import BROKEN_MACHINE, SOME_CRASHED, EngineError, UsageError, unknown
from cosim.core.units import bytes_in_words, duration

cache_app = typer.Typer()
_DAY_S = 86400.0


@cache_app.command(
    "cache",
    epilog="Examples:  \n`cosim cache`  \n`cosim cache --prune`  \n`cosim cache --prune "
    "--unused-for 0`",
)
def show_cache(
    size: Annotated[
        bool, typer.Option("--size", help="Print the sizes; this is the default.")
    ] = False,
    prune: Annotated[
        bool, typer.Option("--prune", help="Remove entries unused for --unused-for days.")
    ] = False,
    unused_for: Annotated[
        float | None,
        typer.Option(
            metavar="DAYS",
            min=0.0,
            help="With --prune: unused for so many days; 0: all.",
            show_default=f"{UNUSED_S / _DAY_S:g}",
        ),
    ] = None,
) -> None:
    """Print the contents of the cache folder, or remove unused entries.

    Removed entries are rebuilt when they are needed. Imported maps and entries that a running
    process uses stay.

    The folder is `$COSIM_CACHE`, by default `~/.cache/sidewalk-cosim`. Beyond
    `$COSIM_CACHE_LIMIT` GB (4 by default), the least recently used entries are removed
    automatically.
    """
    limit_bytes = cache_limit_bytes()
    if unused_for is not None and not prune:
        raise UsageError("--unused-for says what --prune removes: give --prune, too")
    if prune:
        days = UNUSED_S / _DAY_S if unused_for is None else unused_for
        gone = clean_up(days * _DAY_S if days else -math.inf, limit_bytes)
        in_use = f"; {len(gone.in_use)} in use stay" if gone.in_use else ""
        out.print(
            f"Removed: {_counted(len(gone.entries))}, {bytes_in_words(gone.size_bytes)}{in_use}",
            soft_wrap=True,
        )
    if size or not prune:
        _print_sizes(cache_entries())
    whole = sum(entry.size_bytes for entry in cache_entries())
    out.print(
        f"{cache_folder()}: {bytes_in_words(whole)} of at most {limit_bytes / GB:g} GB "
        f"({LIMIT_VARIABLE})",
        soft_wrap=True,
        highlight=False,
    )


def _print_sizes(entries: Sequence[CacheEntry]) -> None:
    """Print number, size and last use of the entries of each kind."""
    columns = [
        *tables.names("kind"),
        *tables.figures("entries", "size"),
        *tables.labels("last used"),
    ]
    columns += tables.words("what it is")
    rows = []
    for kind in CACHE_KINDS:
        of_it = [entry for entry in entries if entry.kind == kind]
        used = (
            f"{duration(time.time() - max(e.used_s for e in of_it))} ago"
            if of_it and not kind.stays
            else ""
        )
        what = f"{kind.words}; never removed" if kind.stays else kind.words
        rows.append(
            (
                kind.name,
                str(len(of_it)),
                bytes_in_words(sum(e.size_bytes for e in of_it)),
                used,
                what,
            )
        )
    tables.show(out, columns, rows)


def _counted(entries: int) -> str:
    return f"{entries} entr{'y' if entries == 1 else 'ies'}"


installation_app = typer.Typer()
_LACKING = "an engine cannot be loaded: {}. Repair it, or install cosim again"


@installation_app.command(epilog="Example:  \n`cosim doctor`")
def doctor() -> None:
    """Check that every engine works here: versions, a frame, a query, a step."""
    try:
        from scenarios.tools.verify.doctor import CHECKS
    except (ImportError, OSError) as error:
        raise EngineError(_LACKING.format(error)) from error

    failed = 0
    for name, check in CHECKS.items():
        try:
            out.print(f"[green]ok[/]      {name}: {check()}", soft_wrap=True)
        except Exception as error:  # noqa: BLE001  a check may fail in any way; it is shown and counted
            failed += 1
            out.print(
                f"[red]failed[/]  {name}: {type(error).__name__}: {escape(str(error))}",
                soft_wrap=True,
            )
    if failed:
        raise typer.Exit(BROKEN_MACHINE)


@installation_app.command(
    epilog="Examples:  \n`cosim verify`  \n`cosim verify --case lh-001-00 --case frontal-001`"
)
def verify(
    case: Annotated[list[str] | None, typer.Option(help="Only this case; may be repeated.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes; with 1 all runs in this one.")] = 2,
    write: Annotated[
        bool,
        typer.Option(
            "--write",
            help="Replace the reference results by those of this installation.",
        ),
    ] = False,
) -> None:
    """Compare this installation with the reference results, and name the cause of a difference.

    Runs the beginnings of 12 scenarios with the oracle: of each suite, the first of each structure
    or event. Draws a picture of each by both cameras, which may differ slightly by OpenGL driver.
    """
    try:
        from scenarios.tools.verify.cases import verified_cases
        from scenarios.tools.verify.shipped import SHIPPED, Results, results_here, writable
        from scenarios.tools.verify.verdict import blamed, findings
    except (ImportError, OSError) as error:
        raise EngineError(_LACKING.format(error)) from error

    cases = {one.id: one for one in verified_cases()}
    for name in case or ():
        if name not in cases:
            raise unknown("case", name, cases)
    picked = [cases[name] for name in dict.fromkeys(case or cases)]
    shipped = None if write else Results.load(SHIPPED)
    with doing(f"running {len(picked)} cases") as progress:
        here = results_here(picked, jobs, progress)
    if shipped is None:
        writable(here, list(cases)).save(SHIPPED)
        out.print(f"{SHIPPED}: {len(here.traces)} cases", soft_wrap=True, highlight=False)
        return
    found = list(findings(shipped, here))
    for one in found:
        mark = "[green]ok[/]     " if one.fine else "[red]differs[/]"
        out.print(
            f"{mark} {escape(one.name)}: {escape(one.words)}", soft_wrap=True, highlight=False
        )
    wrong = [one for one in found if not one.fine]
    for words in blamed(wrong, shipped, here):
        notice(words)
    if wrong:
        err.print(
            f"{len(wrong)} of {len(found)} differ: this is not the installation that was shipped."
        )
        raise typer.Exit(SOME_CRASHED)
    out.print("This installation gives the shipped bits and numbers.")
