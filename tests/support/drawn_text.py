"""Texts of matplotlib figures that are cut off or overlap."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.text import Text

_SLACK_PX = 1.0
"""Margin by which boxes of letters are larger than their ink."""


def clipped_texts(monkeypatch: pytest.MonkeyPatch, draw: Callable[[], object]) -> list[str]:
    """Draw a figure; return each text that is not completely within it, and each pair of
    overlapping texts."""
    from matplotlib.backends.backend_agg import RendererAgg
    from matplotlib.figure import Figure
    from matplotlib.text import Text

    drawn: list[Text] = []
    faults: list[str] = []
    text_draw, figure_draw = Text.draw, Figure.draw

    def noted(self: Text, renderer: Any, *more: Any) -> None:
        if self.get_visible() and self.get_text().strip():
            drawn.append(self)
        text_draw(self, renderer, *more)

    def looked_at(self: Figure, renderer: Any) -> None:
        drawn.clear()
        figure_draw(self, renderer)
        if isinstance(renderer, RendererAgg):
            faults[:] = _faults(drawn, self, renderer)

    with monkeypatch.context() as patch:
        patch.setattr(Text, "draw", noted)
        patch.setattr(Figure, "draw", looked_at)
        draw()
    assert drawn, "nothing was drawn"
    return faults


def _faults(drawn: list[Text], figure: Figure, renderer: Any) -> list[str]:
    boxes = [
        (text.get_text(), text.get_window_extent(renderer).padded(-_SLACK_PX)) for text in drawn
    ]
    wide, high = figure.bbox.width, figure.bbox.height
    cut = [
        f"{words!r} is cut off"
        for words, box in boxes
        if box.x0 < 0.0 or box.y0 < 0.0 or box.x1 > wide or box.y1 > high
    ]
    covers = [
        f"{a!r} covers {b!r}"
        for (a, one), (b, other) in itertools.combinations(boxes, 2)
        if one.overlaps(other)
    ]
    return cut + covers
