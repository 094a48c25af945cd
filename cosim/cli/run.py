"""The command `cosim run`."""

from __future__ import annotations

from typing import Annotated

import typer

from cosim.cli.generated_options import ConfiguredCommand, Fields, configured
from cosim.spec.run_config import RunConfig

run_app = typer.Typer()


@run_app.command(
    "run",
    cls=ConfiguredCommand,
    epilog="Examples:  \n`cosim run long-horizon --policy route --episodes 2`  \n`cosim run "
    "reactive --event frontal --event lateral --policy orca`  \n`cosim run long-horizon --policy "
    "orca --episodes 2 --residents 8`  \n`cosim run long-horizon --robot scout --episodes 2`  "
    "\n`cosim run long-horizon --policy my.py:Mine --jobs 2 --out runs/mine`  \n`cosim run "
    "long-horizon --policy my.py:Mine --out runs/mine --resume`  \n`cosim run long-horizon "
    "--policy my.py:Mine --jobs 10 --shared-renderer`  \n`cosim run reactive --policy orca --seed "
    "7 --shard 1/4 --out runs/1`: see `cosim merge`  \n`cosim run long-horizon --policy "
    "my.py:Mine --isolated --policy-data weights`  \n`cosim run reactive --policy my.py:Mine --on "
    "ray://head.lan:10001`, or `--on ray`  \n`cosim run long-horizon --policy zenoh:mine "
    "--policy-at tcp/127.0.0.1:7449`: see `cosim serve`  \n`cosim run unit --policy ros2: "
    "--ros2-camera none --scenario crosswalk-001`: a ROS 2 node  \n`cosim run reactive --policy "
    "onnx:my_network --goal route_point`  \n`cosim run long-horizon --policy my.py:Mine --goal "
    "route_point`  \n`cosim run reactive --policy my.py:Mine --latency 200`, or `--latency "
    "measured`, or `--real-time`  \n`cosim run long-horizon --map sumo-fkk-in --seed 3 --episodes "
    "5`  \n`cosim run reactive --director tcp/127.0.0.1:7448`, with `cosim direct` in another "
    "terminal  \n`cosim run long-horizon --policy route --episodes 2 --counterfactual`  \n`cosim "
    "run reactive --policy orca --scenario frontal-001 --rerun frontal.rrd`",
)
@configured
def run_command(config: Annotated[RunConfig, Fields(panels=True)]) -> None:
    """Run a suite with a policy and print its table."""
    from cosim.cli.run_display import run_in_terminal

    run_in_terminal(config)
