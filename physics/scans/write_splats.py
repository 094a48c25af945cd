"""Write Gaussian splats as 3DGS .ply."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

SPLAT_ROW: Final = np.dtype(
    [
        (name, "<f4")
        for name in (
            *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
            *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
        )
    ]
)
"""Row of a 3DGS .ply file."""


def write_splats(rows: NDArray[np.void], path: Path) -> None:
    """Write rows of numbers in float32 as a binary .ply file, such as rows of `SPLAT_ROW`."""
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in rows.dtype.names or ()),
        "end_header",
    ]
    path.write_bytes("\n".join(head).encode() + b"\n" + rows.tobytes())
