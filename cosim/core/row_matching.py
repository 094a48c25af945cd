"""Rows: where the people of this moment stood in the table of the moment before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_SAME = slice(None)


@dataclass(slots=True)
class RowLookup:
    """Remembers the names of the last moment. Mostly they are the same: then all rows of that
    moment are told."""

    _ids: tuple[str, ...] = ()

    def of(self, ids: tuple[str, ...]) -> tuple[NDArray[np.intp] | slice, list[int]]:
        """Which rows of the last moment's table are those of `ids`, the last row for who was not
        there; and the places in `ids` of those who were not. Where all were there and are, the rows
        are the whole table, not a copy."""
        if ids and ids == self._ids:
            return _SAME, []
        index = {name: i for i, name in enumerate(self._ids)}
        row = [index.get(name, -1) for name in ids]
        self._ids = ids
        return np.array(row, dtype=np.intp), [i for i, k in enumerate(row) if k < 0]
