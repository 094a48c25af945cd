"""`cosim cache`: what lies in the cache folder, and how to make it smaller."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Annotated

import typer
from rich import box
from rich.table import Column, Table

from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.fitted import print_fitted
from cosim.core.cache import (
    CACHE_KINDS,
    GB,
    LIMIT_VARIABLE,
    UNUSED_S,
    CacheEntry,
    cache_entries,
    cache_folder,
    cache_limit_bytes,
    forget_entries,
)
from cosim.core.errors import UsageError
from cosim.core.telling import bytes_in_words, duration

cache_app = typer.Typer()
_DAY_S = 86400.0


@cache_app.command(
    "cache", epilog="Examples:  \n`cosim cache`  \n`cosim cache --prune`  \n`cosim cache --prune --unused-for 0`"
)
def show_cache(
    size: Annotated[bool, typer.Option("--size", help="Print the sizes; this is the default.")] = False,
    prune: Annotated[bool, typer.Option("--prune", help="Remove what was not used for so long.")] = False,
    unused_for: Annotated[
        float | None,
        typer.Option(
            metavar="DAYS", min=0.0, help="With --prune, since when; 0: all.", show_default=f"{UNUSED_S / _DAY_S:g}"
        ),
    ] = None,
) -> None:
    """Print what lies in the cache folder, or remove what was not used for long.

    Everything that is removed is made again when it is needed. Imported maps stay, and what a running process uses.

    The folder is `$COSIM_CACHE`, by default `~/.cache/sidewalk-cosim`. Where it would be larger than
    `$COSIM_CACHE_LIMIT` GB (4 by default), what was used longest ago is removed without being asked.
    """
    limit_bytes = cache_limit_bytes()
    if unused_for is not None and not prune:
        raise UsageError("--unused-for says what --prune removes: give --prune, too")
    if prune:
        days = UNUSED_S / _DAY_S if unused_for is None else unused_for
        gone = forget_entries(days * _DAY_S if days else -math.inf, limit_bytes)
        in_use = f"; {len(gone.in_use)} in use stay" if gone.in_use else ""
        out.print(f"Removed: {_counted(len(gone.entries))}, {bytes_in_words(gone.size_bytes)}{in_use}", soft_wrap=True)
    if size or not prune:
        _print_sizes(cache_entries())
    whole = sum(entry.size_bytes for entry in cache_entries())
    out.print(
        f"{cache_folder()}: {bytes_in_words(whole)} of at most {limit_bytes / GB:g} GB ({LIMIT_VARIABLE})",
        soft_wrap=True, highlight=False,
    )  # fmt: skip


def _print_sizes(entries: Sequence[CacheEntry]) -> None:
    """Print a row for each kind."""
    heads = (Column("kind", no_wrap=True), Column("entries", justify="right"), Column("size", justify="right"))
    shown = Table(*heads, Column("last used", no_wrap=True), "what it is", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for kind in CACHE_KINDS:
        of_it = [entry for entry in entries if entry.kind == kind]
        used = f"{duration(time.time() - max(e.used_s for e in of_it))} ago" if of_it and not kind.stays else ""
        words = f"{kind.words}; never removed" if kind.stays else kind.words
        shown.add_row(kind.name, str(len(of_it)), bytes_in_words(sum(e.size_bytes for e in of_it)), used, words)
    print_fitted(out, shown, words=(4,))


def _counted(entries: int) -> str:
    return f"{entries} entr{'y' if entries == 1 else 'ies'}"
