"""Linear blend skinning in numpy, as a reference for the shaders."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.geometry import Floats


def skinned(
    vertices: Floats, joints: NDArray[Any], weights: Floats, matrices: NDArray[np.float32]
) -> Floats:
    """Return (V, 3) vertices of one posed body: each the weighted mean of the transforms of its
    joints. vertices (V, 3); joints (V, K) rows; weights (V, K) that sum to 1; matrices (24, 3, 4)
    as from `skinning`."""
    blend = np.einsum("vk,vkab->vab", weights, matrices[joints].astype(float))
    return np.asarray(np.einsum("vab,vb->va", blend[..., :3], vertices) + blend[..., 3])
