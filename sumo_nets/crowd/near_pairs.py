"""Who is near whom among a few hundred points, by numpy alone: scipy's trees take 0.3 s to import."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats


def pairs_within(xy: Floats, reach_m: float) -> NDArray[np.intp]:
    """(P, 2) numbers of those of (N, 2) points that are no farther apart, the lower number first."""
    order = np.argsort(xy[:, 0], kind="stable")
    x_m = xy[order, 0]
    # Along x everybody's neighbours follow it: how many do, and which.
    ahead = np.searchsorted(x_m, x_m + 1.001 * reach_m, side="right") - np.arange(1, len(xy) + 1)
    one = np.repeat(np.arange(len(xy)), ahead)
    other = one + 1 + np.arange(len(one)) - np.repeat(np.cumsum(ahead) - ahead, ahead)
    pairs = np.sort(np.column_stack([order[one], order[other]]), axis=1)
    gap = xy[pairs[:, 0]] - xy[pairs[:, 1]]
    return np.asarray(pairs[(gap * gap).sum(axis=1) <= reach_m * reach_m])
