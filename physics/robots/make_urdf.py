"""Write the URDF files of the robots with legs from their tables.

Run it after a change of a table: `python -m physics.robots.make_urdf`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final

from cosim.core.files import write_atomic
from physics.robots.dog import DOG_MODEL
from physics.robots.model import Model
from physics.robots.walker import WALKER_MODEL

MODELS: Final[Mapping[str, Model]] = MappingProxyType(
    {one.name: one for one in (DOG_MODEL, WALKER_MODEL)}
)
"""Tables of robots, by the names of their URDF files without ending."""


def main() -> None:
    """Write all files to the folder of this module."""
    for name, model in MODELS.items():
        write_atomic(Path(__file__).parent / f"{name}.urdf", model.urdf().encode())


if __name__ == "__main__":
    main()
