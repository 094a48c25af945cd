"""PyBullet, imported without its greeting, which it would write to stderr among progress bars and
tables."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any


def _imported() -> Any:
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            import pybullet
    finally:
        os.dup2(kept, 2)
        os.close(kept)
    return pybullet


p = _imported()
