"""Pictures of the episodes of a run folder."""

from __future__ import annotations

from pathlib import Path

import cv2

from cosim.core.errors import MachineError, RunError
from cosim.report.above import draw_above
from cosim.results.log import Log
from cosim.results.record import Record
from cosim.spec.scenario import read_suite
from scenarios.places.nets import place


def draw_episode(folder: Path, scenario_id: str, output: Path) -> None:
    """Draw an episode from above into an image file. Raises RunError when that cannot be
    written."""
    scenario = {s.id: s for s in read_suite(folder / "scenarios.json").scenarios}[scenario_id]
    episode = folder / "episodes" / scenario_id
    record, log = Record.load(episode / "record.json"), Log.load(episode / "trajectory.npz")
    _, street_map = place(scenario.place)
    image = draw_above(street_map, scenario, record, log)
    try:
        written = cv2.imwrite(str(output), image[..., ::-1])
    except cv2.error as error:
        raise RunError(
            f"{output}: cannot be written as a picture; use a name that ends in .png or .jpg"
        ) from error
    if not written:
        raise MachineError(f"{output}: the picture cannot be written there")
