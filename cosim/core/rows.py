"""Rows: where the people of this moment stood in the table of the moment before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(slots=True)
class RowLookup:
    """Remembers the names of the last moment. Mostly they are the same: then the rows of that moment are told again."""

    _ids: tuple[str, ...] = ()
    _same: tuple[NDArray[np.intp], NDArray[np.bool_]] = (np.zeros(0, dtype=np.intp), np.zeros(0, dtype=bool))

    def of(self, ids: tuple[str, ...]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """(N,) rows of `ids` in the last moment's table, the last row for who was not there, and (N,) who was."""
        if ids == self._ids:
            return self._same
        index = {name: i for i, name in enumerate(self._ids)}
        row = np.array([index.get(name, -1) for name in ids], dtype=np.intp)
        self._ids = ids
        self._same = np.arange(len(ids)), np.ones(len(ids), dtype=bool)
        return row, row >= 0
