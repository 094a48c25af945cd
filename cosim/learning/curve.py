"""Learning curve, one row per evaluation, as a file and a picture; needs no PyTorch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from cosim.core.files import write_atomic

CURVE: Final = "curve.csv"
PICTURE: Final = "curve.png"


def write_curve(folder: Path, curve: Sequence[Mapping[str, float]]) -> None:
    """Write the rows as `curve.csv`. Raises OSError."""
    lines = [
        ",".join(curve[0]),
        *(",".join(f"{value:.6g}" for value in row.values()) for row in curve),
    ]
    write_atomic(folder / CURVE, ("\n".join(lines) + "\n").encode())


def draw_curve(folder: Path) -> None:
    """Draw `curve.csv` as `curve.png`: losses and held-out errors by step. Needs matplotlib."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    names, *rows = [line.split(",") for line in (folder / CURVE).read_text().splitlines()]
    columns = {name: [float(row[i]) for row in rows] for i, name in enumerate(names)}
    steps = columns.pop("step")
    lines = -(-len(columns) // 5)
    figure, axes = plt.subplots(lines, 5, figsize=(15, 2.5 * lines), layout="constrained")
    for axis in axes.flat[len(columns) :]:
        axis.set_axis_off()
    for axis, (name, values) in zip(axes.flat, columns.items(), strict=False):
        axis.plot(steps, values, marker="o" if len(steps) == 1 else "")
        axis.set_title(name.replace("_", " "))
        axis.grid(alpha=0.3)
    figure.savefig(folder / PICTURE)
    plt.close(figure)
