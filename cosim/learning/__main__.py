"""`python -m cosim.learning`: `cosim train` in a Python that has only PyTorch, NumPy and onnx."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from cosim.core.errors import TIME_IS_UP, CosimError
from cosim.learning.settings import NETWORK_DEFAULTS, PLANNED_STEPS, Training, batches_in_words
from cosim.learning.training import train_and_report


def _main() -> None:
    """Parse the command line and train."""
    parser = argparse.ArgumentParser(
        prog="python -m cosim.learning",
        description="Train a policy on packed demonstrations.",
    )
    default = Training()
    parser.add_argument(
        "data", nargs="+", type=Path, help="packed demonstrations: cosim dataset pack"
    )
    parser.add_argument("-o", "--out", type=Path, required=True, help="the folder of the bundle")
    parser.add_argument("--from", dest="begin", type=Path, help="a bundle to train on from")
    parser.add_argument(
        "--steps", type=int, help=f"in all; by default {PLANNED_STEPS}, or as planned before"
    )
    parser.add_argument("--seed", type=int, default=default.seed)
    parser.add_argument("--network", default=default.network, choices=list(NETWORK_DEFAULTS))
    parser.add_argument("--batch", type=int, help=f"by default {batches_in_words()}")
    parser.add_argument("--rate", type=float, default=default.rate)
    parser.add_argument("--device", default=default.device)
    parser.add_argument("--minutes", type=float, default=default.minutes, help="stop after so long")
    parser.add_argument("--name", default=default.name, help="by default that of the network")
    parser.add_argument("--share", type=float, default=default.share, help="of training episodes")
    parser.add_argument(
        "--values", type=float, default=default.values, help="weigh rows with rewards: 1"
    )
    for ablated in ("memory", "auxiliary", "decoys", "weather"):
        parser.add_argument(f"--no-{ablated}", dest=ablated, action="store_false")
    parser.add_argument("--resume", action="store_true", help="continue the training in the folder")
    words = vars(parser.parse_args())
    data, out, resume = words.pop("data"), words.pop("out"), words.pop("resume")
    try:
        whole = train_and_report(
            data,
            out,
            Training(**words),
            resume,
            lambda line: print(line, file=sys.stderr, flush=True),
        )
    except CosimError as error:
        raise SystemExit(f"error: {error}") from None
    raise SystemExit(0 if whole else TIME_IS_UP)


if __name__ == "__main__":
    _main()
