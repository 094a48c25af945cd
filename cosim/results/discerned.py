"""Discerned (D): the share of pairs of an event and its decoy in which both are solved.

A pair with an invalid member has no value. A member whose policy crashed is unsolved. A pair counts
only if both members were run. All other means of a run are over scenarios without decoys.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from cosim.core.geometry import Floats

DISCERNED: Final = "discerned"
"""Name of D among the metrics; it exists for pairs, not for episodes."""
DISCERNED_IN_WORDS: Final = "share of events solved with their decoys"


class Pairs(NamedTuple):
    """Pairs of a table with one row per episode.

    solved: 1 or 0 by id of the decoy; NaN if a member is invalid
    single: number of episodes whose other member has no row, among kinds that have decoys here
    """

    solved: pd.Series[float]
    single: int

    @property
    def values(self) -> Floats:
        """Values of the pairs without invalid members."""
        return np.asarray(self.solved.dropna(), dtype=float)

    @property
    def invalid(self) -> int:
        """Number of pairs with an invalid member."""
        return len(self.solved) - len(self.values)

    @property
    def in_words(self) -> str:
        """Describe the number of pairs and those left out.

        >>> Pairs(pd.Series([1.0, float("nan")]), single=2).in_words
        '1 pair; left out: 1 with an invalid member, 2 episodes without the other member'
        """
        n = len(self.values)
        left_out = [f"{self.invalid} with an invalid member"] * bool(self.invalid)
        episodes = f"{self.single} episode{'s' * (self.single != 1)}"
        left_out += [f"{episodes} without the other member"] * bool(self.single)
        more = f"; left out: {', '.join(left_out)}" if left_out else ""
        return f"{n} pair{'s' * (n != 1)}{more}"


def is_decoy(table: pd.DataFrame) -> pd.Series[bool]:
    """Return which rows are decoys."""
    if "decoy_of" not in table:
        return pd.Series(False, index=table.index)
    return table["decoy_of"].fillna("") != ""


def has_decoys(table: pd.DataFrame) -> bool:
    """Return whether a table has decoys."""
    return bool(is_decoy(table).any())


def without_decoys(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows that are no decoys."""
    return table[~is_decoy(table)]


def with_discerned(heads: Mapping[str, str], decoys: bool) -> dict[str, str]:
    """Return metrics with their heads; `discerned` after success if there are decoys.

    >>> list(with_discerned({"success": "SR", "spl": "SPL"}, decoys=True))
    ['success', 'discerned', 'spl']
    """
    found: dict[str, str] = {}
    for metric, head in heads.items():
        found[metric] = head
        if metric == "success" and decoys:
            found[DISCERNED] = "D"
    return found


def episode_pairs(table: pd.DataFrame) -> Pairs:
    """Return the pairs of a table with one row per episode."""
    if not has_decoys(table):
        return Pairs(pd.Series(dtype=float), 0)
    success = pd.to_numeric(table["success"], errors="coerce").astype(float)
    rows = table.assign(solved=success.mask(table["status"] == "invalid"))
    decoys = rows[is_decoy(rows)]
    events = without_decoys(rows)
    events = events[events["structure"].isin({*decoys["structure"]})]
    both = decoys.merge(
        events, left_on=["suite_hash", "decoy_of"], right_on=["suite_hash", "scenario"]
    )
    members = both.set_index("scenario_x")[["solved_x", "solved_y"]]
    solved = members.min(axis=1, skipna=False)
    paired = both["scenario_y"].nunique()
    return Pairs(solved, len(decoys) - len(both) + len(events) - paired)
