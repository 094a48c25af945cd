"""Agreement of two pictures of one view."""

from __future__ import annotations

import cv2
import numpy as np

from cosim.core.state import Frame


def off_edges(*labels: np.ndarray) -> np.ndarray:
    """Return where no label changes within 2 pixels, in any of the pictures."""
    window = np.ones((5, 5), dtype=np.uint8)
    return np.logical_and.reduce([cv2.dilate(a, window) == cv2.erode(a, window) for a in labels])


def agreement(first: Frame, second: Frame) -> tuple[float, float]:
    """Return the share of the pixels off edges whose labels agree, and the median difference of
    depths in metres."""
    assert (
        first.labels is not None
        and second.labels is not None
        and first.depth is not None
        and second.depth is not None
    )
    clear = off_edges(first.labels, second.labels)
    near = clear & (first.depth < 100.0) & (second.depth < 100.0)
    label_share = (first.labels == second.labels)[clear].mean()
    return float(label_share), float(np.median(np.abs(first.depth - second.depth)[near]))
