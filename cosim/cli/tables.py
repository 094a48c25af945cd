"""Print tables in terminals of any width: no cell of a figure is ever cut."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Final

from rich.cells import cell_len
from rich.console import Console, RenderableType
from rich.measure import Measurement
from rich.table import Column, Table

_LEAST_NAME: Final = 12
"""Letters of a line to which a column of names is folded before a table is divided."""
_UNBOUNDED: Final = 10_000
"""Columns of a terminal in which everything has its natural width."""


def print_fitted(out: Console, table: Table, names: int = 1, words: Sequence[int] = ()) -> None:
    """Print a table; one that is too wide with broken heads, then folded names, then in parts one
    below the other.

    names: the number of leading columns that say what a row is; each part has them. words: the
    numbers of further columns that may be folded, such as sentences. All others hold figures, which
    stay in one piece.
    """
    for part in parts_of_table(out, table, names, words):
        out.print(part)


def parts_of_table(
    out: Console, table: Table, names: int = 1, words: Sequence[int] = ()
) -> list[Table]:
    """The parts of a table that fit into a terminal; see `print_fitted`."""
    flexible = {*range(names), *words}
    for number, column in enumerate(table.columns):
        column.no_wrap = number not in flexible
        column.overflow = "fold"
    heads, cells = zip(*(_widths(out, column) for column in table.columns), strict=True)
    natural = [*map(max, heads, cells)]
    if sum(natural) + _frame(out, table, len(natural)) <= out.width:
        return [table]
    least = [min(width, _LEAST_NAME) for width in natural]
    for number in {*range(len(natural))} - flexible:
        least[number] = _break_head(table.columns[number], cells[number])
    parts: list[list[int]] = [[*range(names)]]
    for number in range(names, len(natural)):
        wanted = [*parts[-1], number]
        if (
            len(wanted) > names + 1
            and sum(least[i] for i in wanted) + _frame(out, table, len(wanted)) > out.width
        ):
            wanted = [*range(names), number]
            parts.append(wanted)
        parts[-1] = wanted
    return [_part(table, [table.columns[number] for number in part]) for part in parts]


def _part(table: Table, columns: Sequence[Column]) -> Table:
    """A table with some of its columns."""
    part = copy(table)
    part.columns = [replace(column, _index=number) for number, column in enumerate(columns)]
    return part


def _frame(out: Console, table: Table, columns: int) -> int:
    """How many letters of a line lie between and beside so many columns."""
    empty = _part(table, [Column("x")] * columns)
    empty.rows = []
    empty.title = None
    empty.caption = None
    return _longest(out, empty) - columns


def _break_head(column: Column, widest: int) -> int:
    """Break the head of a column that is wider than its cells into lines of whole words. Returns
    the column's width."""
    if isinstance(column.header, str):
        lines = [
            textwrap.wrap(line, max(1, widest), break_long_words=False)
            for line in column.header.split("\n")
        ]
        column.header = "\n".join(line for wrapped in lines for line in wrapped)
        return max([widest, *map(cell_len, column.header.split("\n"))])
    return widest


def _widths(out: Console, column: Column) -> tuple[int, int]:
    """How wide a column's head is, and its widest cell."""
    return _longest(out, column.header), max(
        (_longest(out, cell) for cell in column.cells), default=0
    )


def _longest(out: Console, shown: RenderableType) -> int:
    """Letters of the longest line of something that has all the room it wants."""
    return Measurement.get(out, out.options.update(max_width=_UNBOUNDED), shown).maximum
