"""Print tables in terminals of any width without cutting numbers."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from typing import Final, Literal, NamedTuple

from rich import box
from rich.cells import cell_len
from rich.console import Console, JustifyMethod
from rich.table import Table
from rich.text import Text

_MIN_NAME: Final = 12
"""Characters to which a column of names or words may be folded before a table is divided."""
_LAYOUTS: Final = ((True, 1), (True, 0), (False, 0))
"""Layouts (edge, padding in characters). The first one that fits is used."""

Cell = str | Text
Row = Sequence[Cell] | None
"""The cells of a row. None begins a new section of the table."""


class Column(NamedTuple):
    """A column of a table.

    kind:
    - "name" identifies a row. It may be folded, comes first, and is repeated in divided tables.
    - "figure" is right-aligned and never folded.
    - "label" is left-aligned and never folded.
    - "words" may be folded.
    """

    head: str
    kind: Literal["name", "figure", "label", "words"]

    @property
    def folds(self) -> bool:
        return self.kind in ("name", "words")


def names(*heads: str) -> list[Column]:
    """Return columns that identify a row."""
    return [Column(head, "name") for head in heads]


def figures(*heads: str) -> list[Column]:
    """Return columns of numbers, right-aligned."""
    return [Column(head, "figure") for head in heads]


def labels(*heads: str) -> list[Column]:
    """Return columns of short words that are never folded."""
    return [Column(head, "label") for head in heads]


def words(*heads: str) -> list[Column]:
    """Return columns of sentences, which may be folded."""
    return [Column(head, "words") for head in heads]


def show(
    out: Console, columns: Sequence[Column], rows: Iterable[Row], *, title: str = "", note: str = ""
) -> None:
    """Print a table.

    A table that is too wide gets less padding, then broken heads, then folded names. If that is
    not enough, it is divided into parts below each other.

    title, note: lines above and below the table.
    """
    for part in fitted(out, columns, rows, title=title, note=note):
        out.print(part)


def fitted(
    out: Console, columns: Sequence[Column], rows: Iterable[Row], *, title: str = "", note: str = ""
) -> list[Table]:
    """Return the parts of a table that fit into a terminal; see `show`."""
    rows = [*rows]
    cells = [max((_width(row[k]) for row in rows if row), default=0) for k in range(len(columns))]
    natural = [
        max(_width(column.head), widest) for column, widest in zip(columns, cells, strict=True)
    ]
    edge, pad = next((one for one in _LAYOUTS if _total(natural, *one) <= out.width), _LAYOUTS[-1])
    parts = [[*range(len(columns))]]
    if _total(natural, edge, pad) > out.width:
        columns = [
            column if column.folds else _broken(column, cells[k])
            for k, column in enumerate(columns)
        ]
        least = [
            min(natural[k], _MIN_NAME) if column.folds else max(_width(column.head), cells[k])
            for k, column in enumerate(columns)
        ]
        parts = _divided(columns, least, out.width)
    tables = []
    for part in parts:
        table = Table(
            box=box.SIMPLE_HEAD, show_edge=edge, padding=(0, pad, 0, 0), title=title or None
        )
        table.caption = note or None
        table.title_justify = table.caption_justify = "left"
        for column in (columns[k] for k in part):
            justify: JustifyMethod = "right" if column.kind == "figure" else "left"
            table.add_column(
                Text(column.head), justify=justify, no_wrap=not column.folds, overflow="fold"
            )
        for row in rows:
            if row is None:
                table.add_section()
            else:
                table.add_row(*(_text(row[k]) for k in part))
        tables.append(table)
    return tables


def _divided(columns: Sequence[Column], least: Sequence[int], width: int) -> list[list[int]]:
    """Return the column indices of each part, with all names and at least one other column."""
    leading = [k for k, column in enumerate(columns) if column.kind == "name"]
    parts = [leading]
    for k in range(len(leading), len(columns)):
        part = [*parts[-1], k]
        if len(part) > len(leading) + 1 and _total([least[i] for i in part], *_LAYOUTS[-1]) > width:
            part = [*leading, k]
            parts.append(part)
        parts[-1] = part
    return parts


def _total(widths: Sequence[int], edge: bool, pad: int) -> int:
    """Return the width of a table with columns of these widths."""
    return sum(widths) + pad * len(widths) + len(widths) - 1 + 2 * edge


def _broken(column: Column, widest: int) -> Column:
    """Break a head that is wider than its cells into lines of whole words."""
    lines = [
        textwrap.wrap(line, max(1, widest), break_long_words=False)
        for line in column.head.split("\n")
    ]
    return column._replace(head="\n".join(line for wrapped in lines for line in wrapped))


def _text(cell: Cell) -> Text:
    return Text(cell) if isinstance(cell, str) else cell


def _width(cell: Cell) -> int:
    """Return the width of the longest line, in terminal cells."""
    return max(map(cell_len, str(cell).split("\n")))
