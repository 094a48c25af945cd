"""`python -m scenarios.tools.scans.train_splats`: splats of a real street from its photos.

Runs in a Python that has only PyTorch, gsplat, NumPy, SciPy and OpenCV.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import CosimError, MachineError, MapError, UsageError
from cosim.core.geometry import Floats
from physics.scans.sources import read_ply_header, read_source
from physics.scans.write_splats import write_splats
from scenarios.tools.scans.colmap import read_model
from scenarios.tools.scans.photos import (
    EACH,
    Photo,
    fitted,
    photo_folder,
    psnr_db,
    read_photos,
    split,
)

if TYPE_CHECKING:
    from scenarios.tools.scans.training import Trainer

INSTALL: Final = "pip install torch gsplat==1.5.3 ninja"
"""Command that installs what only the training needs."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    found = argparse.ArgumentParser(
        prog="python -m scenarios.tools.scans.train_splats",
        description="Train Gaussian splats from photos and their COLMAP model, on an NVIDIA GPU.",
    )
    found.add_argument("colmap", type=Path, help="folder with images and sparse/0")
    found.add_argument("out", type=Path, help="folder to write to: splats.ply, metrics.json")
    found.add_argument("--images", type=Path, help="folder of the photos; by default images")
    found.add_argument(
        "--points",
        type=Path,
        help="dense points in the model's frame (COLMAP's fused.ply) at which splats start",
    )
    found.add_argument(
        "--leave-out", nargs="+", default=[], metavar="NAME", help="photos with a wrong pose"
    )
    found.add_argument("--size", type=int, default=1024, help="longest side of photos, pixels")
    found.add_argument("--steps", type=int, default=7000, help="one photo each")
    found.add_argument("--most", type=int, default=500_000, help="maximum number of splats")
    found.add_argument("--minutes", type=float, default=float("inf"), help="stop after so long")
    found.add_argument("--seed", type=int, default=0)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Train splats, write them with their metrics, and print the metrics. Exits on errors."""
    words = parser().parse_args(arguments)
    try:
        _train(words)
    except CosimError as error:
        raise SystemExit(f"error: {error}") from None


def _train(words: argparse.Namespace) -> None:
    """Read everything before PyTorch is needed, then train."""
    if words.size < 64 or words.steps < 1 or words.most < 1000 or not words.minutes > 0.0:
        raise UsageError("--size must be at least 64, --steps 1, --most 1000, --minutes above 0")
    model = read_model(words.colmap)
    photos = read_photos(
        model, words.images or photo_folder(words.colmap), words.size, words.leave_out
    )
    training, held_out = split(photos)
    points, colours = model.points, model.colours
    if words.points is not None:
        points, colours = read_points(words.points)
    _say(
        f"{len(training)} photos to train on, {len(held_out)} held out; {len(points)} first points"
    )
    check_installed()
    from scenarios.tools.scans.training import Settings, Trainer

    settings = Settings(steps=words.steps, most=words.most, minutes=words.minutes, seed=words.seed)
    trainer = Trainer(training, model.points, points, colours, settings)
    steps = trainer.train(_say)
    words.out.mkdir(parents=True, exist_ok=True)
    rows = trainer.rows()
    path = words.out / "splats.ply"
    write_splats(rows, path)
    found = {
        "splats": len(rows),
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "steps": steps,
        "seed": words.seed,
        "versions": {name: version(name) for name in ("torch", "gsplat")},
        **measured(trainer, training, held_out, words.out),
    }
    (words.out / "metrics.json").write_text(json.dumps(found, indent=1) + "\n")
    print(table(found))


def check_installed() -> None:
    """Check that PyTorch, gsplat and a GPU can be used. Raises MachineError with the remedy."""
    if lacking := [name for name in ("torch", "gsplat") if find_spec(name) is None]:
        raise MachineError(
            f"{' and '.join(lacking)} cannot be imported: {INSTALL} (gsplat compiles its kernels "
            "at first use, which needs nvcc of CUDA's toolkit)"
        )
    import torch

    if not torch.cuda.is_available():
        raise MachineError(
            "PyTorch sees no NVIDIA GPU, and gsplat needs one: run this on a GPU host, or check "
            "`nvidia-smi` and that PyTorch is not the CPU build"
        )


def read_points(path: Path) -> tuple[Floats, NDArray[np.uint8]]:
    """Return places (N, 3) and colours (N, 3) of the points of a binary .ply file.

    Raises MapError.
    """
    data = read_source(path)
    header = read_ply_header(path, data)
    vertex = header.elements[0]
    names = [name for name, _ in vertex.properties]
    wanted = ("x", "y", "z", "red", "green", "blue")
    if header.form != "binary_little_endian" or not set(wanted) <= set(names):
        raise MapError(
            f"{path}: is {header.form} with the properties {', '.join(names)}; it must be "
            f"binary_little_endian with {', '.join(wanted)}: give COLMAP's fused.ply"
        )
    row = np.dtype([(name, f"<{kind}") for name, kind in vertex.properties])
    if vertex.count == 0 or len(data) - header.size < vertex.count * row.itemsize:
        raise MapError(
            f"{path}: its header promises {vertex.count} points, and {len(data) - header.size} "
            "bytes follow: make it again"
        )
    rows = np.frombuffer(data, row, vertex.count, header.size)
    at = np.stack([rows[name].astype(np.float64) for name in "xyz"], axis=1)
    return at, np.stack([rows[name].astype(np.uint8) for name in wanted[3:]], axis=1)


def measured(
    trainer: Trainer, training: Sequence[Photo], held_out: Sequence[Photo], folder: Path
) -> dict[str, Any]:
    """Return PSNR in dB of all photos; write pictures of those that are held out.

    A picture has the photo on the left and the drawing on the right.
    """
    import cv2

    from scenarios.tools.scans.training import pictures_beside

    found: dict[str, Any] = {}
    for kind, photos in (("held_out", held_out), ("trained", training)):
        rows = {}
        for photo in photos:
            drawn = trainer.draw(photo)
            rows[photo.name] = compared(drawn, photo)
            if kind == "held_out":
                beside = cv2.cvtColor(pictures_beside(photo.rgb, drawn), cv2.COLOR_RGB2BGR)
                cv2.imwrite(str(folder / f"held-out-{Path(photo.name).stem}.png"), beside)
        found[kind] = {"mean": _mean(list(rows.values())), "photos": rows}
    return found


def compared(drawn: NDArray[np.float32], photo: Photo) -> dict[str, float]:
    """Return the PSNR of a drawing in dB: as it is, and after the exposure that fits the photo."""
    exact = (photo.rgb / 255.0).astype(np.float32)
    return {
        "psnr_db": round(psnr_db(drawn, exact), 3),
        "psnr_fitted_db": round(psnr_db(fitted(drawn, exact), exact), 3),
    }


def _mean(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    return {key: round(float(np.mean([row[key] for row in rows])), 3) for key in rows[0]}


def table(found: dict[str, Any]) -> str:
    """Return the metrics as text."""
    lines = [f"{'photo':24} {'PSNR dB':>8} {'exposure fitted':>16}"]
    rows = [
        *found["held_out"]["photos"].items(),
        (f"mean held out (1 in {EACH})", found["held_out"]["mean"]),
        ("mean trained on", found["trained"]["mean"]),
    ]
    for name, row in rows:
        lines.append(f"{name:24} {row['psnr_db']:8.2f} {row['psnr_fitted_db']:16.2f}")
    lines.append(f"splats.ply: {found['splats']} splats, sha256 {found['sha256']}")
    return "\n".join(lines)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
