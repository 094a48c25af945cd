"""The command `cosim train`."""

from __future__ import annotations

import math
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.console import notice
from cosim.cli.options import LEARN
from cosim.core.errors import TIME_IS_UP, MachineError
from cosim.learning.settings import PLANNED_STEPS, TO_INSTALL, Training, batches_in_words

train_app = typer.Typer()


@train_app.command(
    "train",
    rich_help_panel=LEARN,
    epilog="Examples:  \n`cosim train unit.npz -o small --minutes 9 --resume`  \n"
    "`cosim train reactive.npz unit.npz -o mine --from small --steps 6000 --rate 3e-4 --seed 1`  \n"
    "`cosim train demos-*.npz -o sidewalk --network sidewalk --minutes 9 --resume`",
)
def train_command(
    data: Annotated[
        list[Path],
        typer.Argument(metavar="DATA...", help="Packed demonstrations: `cosim dataset pack`."),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FOLDER", help="The folder of the bundle.")
    ],
    begin: Annotated[
        Path | None,
        typer.Option("--from", metavar="FOLDER", help="Begin with the bundle of another training."),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of batches in all.",
            show_default=f"{PLANNED_STEPS}; with --resume as before",
        ),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            help="Seed of initial parameters and batches; of small also of held-out episodes.",
        ),
    ] = 0,
    network: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="small, which sees four pictures of 160x90, or sidewalk, which sees 320x180, and "
            "has a memory and auxiliary heads.",
        ),
    ] = "small",
    batch: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Examples per step, of sidewalk windows of 8 s.",
            show_default=batches_in_words(),
        ),
    ] = None,
    rate: Annotated[float, typer.Option(help="Peak learning rate; it then falls to 0.")] = 1e-3,
    device: Annotated[
        str, typer.Option(help="cpu, cuda, cuda:1; by default a GPU if there is one.")
    ] = "",
    minutes: Annotated[
        float,
        typer.Option(
            help="Stop after so long, with a bundle and exit code 4: --resume continues.",
            show_default="no limit",
        ),
    ] = math.inf,
    name: Annotated[
        str,
        typer.Option(
            help="The policy's name in records and tables.", show_default="that of the network"
        ),
    ] = "",
    share: Annotated[
        float,
        typer.Option(help="Ablation of sidewalk: share of the training episodes.", max=1.0),
    ] = 1.0,
    no_memory: Annotated[
        bool, typer.Option("--no-memory", help="Ablation of sidewalk: no memory.")
    ] = False,
    no_auxiliary: Annotated[
        bool, typer.Option("--no-auxiliary", help="Ablation of sidewalk: no auxiliary heads.")
    ] = False,
    no_decoys: Annotated[
        bool, typer.Option("--no-decoys", help="Ablation of sidewalk: no decoys.")
    ] = False,
    no_weather: Annotated[
        bool, typer.Option("--no-weather", help="Ablation of sidewalk: clear weather alone.")
    ] = False,
    values: Annotated[
        float,
        typer.Option(
            metavar="TEMPERATURE",
            help="Fine-tuning of sidewalk on rewards: weigh what the bundle of --from drove with "
            "`cosim collect --explore` by how well it went on; 1 is usual, more is milder.",
            show_default="0, equal weights",
        ),
    ] = 0.0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue the training in the folder.")
    ] = False,
) -> None:
    """Train a camera policy on demonstrations, as a bundle for --policy onnx:FOLDER.

    A checkpoint is saved every minute. A finished training continues with `--resume` and larger
    `--steps`.

    Needs PyTorch and onnx, and no engine. Install the CPU build first, unless you have an NVIDIA
    GPU: `pip install torch --index-url https://download.pytorch.org/whl/cpu`. `python -m
    cosim.learning` is the same command in a Python that has PyTorch, onnx and NumPy alone.
    """
    if lacking := [package for package in ("torch", "onnx") if find_spec(package) is None]:
        raise MachineError(f"{' and '.join(lacking)} cannot be imported: {TO_INSTALL}")
    from cosim.learning.training import train_and_report

    training = Training(
        steps=steps,
        seed=seed,
        batch=batch,
        rate=rate,
        device=device,
        begin=begin,
        minutes=minutes,
        name=name,
        network=network,
        share=share,
        memory=not no_memory,
        auxiliary=not no_auxiliary,
        decoys=not no_decoys,
        weather=not no_weather,
        values=values,
    )
    if not train_and_report(data, out, training, resume, notice):
        raise typer.Exit(TIME_IS_UP)
