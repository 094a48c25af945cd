"""The look of a scan does not change the simulated state."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.run_config import Appearance
from cosim.spec.scenario import City, CrowdSpec
from scenarios.episodes.run_episode import run_episode
from scenarios.places.nets import place
from scenarios.places.scan_import import import_scan
from scenarios.places.scan_make import crossing_box, make_scan
from scenarios.places.scan_options import read_options
from scenarios.suites.sample import suite_on_map

CAMERA = CameraSpec(width=64, height=36)


class Swaying:
    """Drives in curves, with or without a camera, and stores its pictures."""

    def __init__(self, camera: CameraSpec | None, w_radps: float = 0.2) -> None:
        self._w_radps = w_radps
        self.manifest = Manifest("swaying", rate_hz=2.0, camera=camera)
        self.pictures: list[np.ndarray] = []

    def reset(self, episode_id: str, seed: int) -> None:
        self.pictures.clear()

    def act(self, observation: Observation) -> Command:
        if observation.rgb is not None:
            self.pictures.append(np.array(observation.rgb))
        return Command(0.6, self._w_radps if observation.time_s % 2.0 < 1.0 else -self._w_radps)


@pytest.mark.engine
def test_the_look_of_a_scan_never_changes_the_state(tmp_path: Path) -> None:
    """With mesh, with splats and without a camera an episode with people has the same state hash
    and other pictures; other commands have another hash."""
    city = City(seed=7, size_m=300.0)
    x0, y0, x1, y1 = crossing_box(place(city)[1])
    folder = tmp_path / "states"
    make_scan(city, (x0 + 20, y0 + 15, x1 - 20, y1 - 15), folder, spacing_m=0.25)
    import_scan(folder, read_options(folder, {}))
    (drawn,) = suite_on_map("unit", "states", 0, 1).scenarios
    scenario = msgspec.structs.replace(
        drawn, crowd=CrowdSpec(persons=4), ends_on_failure=False, time_limit_s=4.0, obstacles=()
    )
    hashes = {}
    pictures = {}
    looks: tuple[tuple[Appearance, CameraSpec | None], ...] = (
        *(("mesh", CAMERA), ("splats", CAMERA)),
        ("splats", None),
    )
    for appearance, camera in looks:
        policy = Swaying(camera)
        options = EpisodeOptions(appearance=appearance, own_camera=True)
        record = run_episode(scenario, policy, options).record
        assert record.status == "done", record.reason
        look = "none" if camera is None else appearance
        hashes[look], pictures[look] = record.state_hash, policy.pictures
    assert hashes["mesh"] == hashes["splats"] == hashes["none"]
    assert len(pictures["mesh"]) == len(pictures["splats"]) == 8
    assert np.abs(pictures["mesh"][-1].astype(float) - pictures["splats"][-1]).mean() > 0.5
    assert not pictures["none"]
    other = run_episode(scenario, Swaying(None, -0.2)).record
    assert other.state_hash != hashes["none"]
