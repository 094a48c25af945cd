"""The command line of data sets: `cosim dataset pack`, `show`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.options.camera import size_called
from cosim.cli.options.output_file import check_output, replaced
from cosim.cli.terminal.consoles import out
from cosim.cli.terminal.progress import doing

dataset_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode="markdown", help="What `cosim collect` has made, for training."
)


@dataset_app.command(
    "pack",
    epilog="Examples:  \n`cosim dataset pack demos/unit -o unit.npz`  \n"
    "`cosim dataset pack demos/unit demos/gesturing -o both.npz --size 96x96`",
)
def pack(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Data sets, one after another.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="Where to write the arrays, a .npz.")],
    size: Annotated[str, typer.Option(metavar="WxH", help="Pixels of the pictures, in place of their own.")] = "",
) -> None:
    """Write data sets as plain arrays: pictures, speeds, goals, commands, waypoints, for who has numpy alone.

    The arrays are told in `cosim/core/packed.py`; `cosim.core.packed.read_packed` reads them.
    """
    from scenarios.collecting.demonstration import check_parquet

    check_parquet()
    check_output(output, "packed arrays", (".npz",))
    wanted = size_called("--size", size) if size else None
    from scenarios.collecting.reading import packed_sets

    instead = replaced(output)
    with doing("reading the rows") as tell:
        packed = packed_sets(folders, wanted, tell)
        tell("writing the arrays")
        packed.save(output)
    shape = " x ".join(map(str, packed.frames.shape))
    out.print(
        f"Packed: {output} ({len(packed.meta['scenarios'])} episodes, pictures {shape}, "
        f"{output.stat().st_size / 1e6:.1f} MB){instead}",
        soft_wrap=True, highlight=False,
    )  # fmt: skip
