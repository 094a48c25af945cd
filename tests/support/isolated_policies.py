"""Policies for test_isolated.py: all send the same commands, and do something beside that no policy
should.

`names.json` in the folder that ISOLATED_DESK names says which of the deeds an episode is for.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.errors import PolicyServerLost
from cosim.core.state import Command
from cosim.episode.interfaces import Observation
from cosim.spec.camera import CameraSpec
from cosim.spec.manifest import Manifest

DESK = "ISOLATED_DESK"
FLOOD_BYTES = 64 << 20
ENGINES = ("libsumo", "pybullet", "moderngl", "zenoh", "sumo_nets", "physics")


class Honest:
    """Drives straight ahead."""

    manifest = Manifest(
        "honest", rate_hz=4.0, camera=CameraSpec(64, 40), goal="route_patch", odometry="wheel"
    )

    def reset(self, episode_id: str, seed: int) -> None:
        """Nothing to forget."""

    def act(self, seen: Observation) -> Command:
        assert seen.rgb is not None and seen.rgb.shape == (40, 64, 3) and seen.camera is not None
        return Command(1.0 + float(seen.rgb.mean()) / 1e4, 0.0)


class Hanging(Honest):
    """Is never made."""

    def __init__(self) -> None:
        time.sleep(3600)


class Cheat(Honest):
    """Does, when it is asked for the second time, what its episode is called."""

    def reset(self, episode_id: str, seed: int) -> None:
        names = json.loads((Path(os.environ[DESK]) / "names.json").read_text())
        self.deed = DEEDS[names[episode_id]]
        self.at_end = AFTERWARDS.get(names[episode_id], lambda: None)
        self.count = 0

    def act_batch(
        self, observations: Sequence[Observation]
    ) -> list[Command | np.ndarray[Any, Any]]:
        return [self.act(seen) for seen in observations]

    def ended(self, episode_id: str) -> None:
        self.at_end()

    def act(self, seen: Observation) -> Command | np.ndarray[Any, Any]:
        self.count += 1
        command = super().act(seen)
        if self.count == 2:
            answer = self.deed(seen)
            return answer if isinstance(answer, np.ndarray) else command
        return command


def _patches(seen: Observation) -> None:
    from cosim.results import metrics
    from cosim.results.record import Record
    from cosim.results.referee import Referee, Verdict

    Referee.judge = lambda self, step: Verdict(ended="goal")
    Record.encoded = lambda self: b"{}"
    metrics.METRICS = {}


def _peeks(seen: Observation) -> None:
    """Notes which engines are in its process, and what of the street; then asks SUMO."""
    found = [name for name in ENGINES if name in sys.modules]
    known = [
        one for one in gc.get_objects() if type(one).__name__ in ("Street", "People", "Scenario")
    ]
    found += [type(one).__name__ for one in known if type(one).__name__ != "People" or len(one)]
    import libsumo

    with suppress(libsumo.TraCIException, libsumo.FatalTraCIError):
        found += libsumo.person.getIDList()
    (Path(os.environ[DESK]) / "peeked.json").write_text(json.dumps(found))


def _scribbles(seen: Observation) -> None:
    assert seen.rgb is not None and seen.camera is not None
    seen.rgb[:] = 0
    np.asarray(seen.camera.matrix).setflags(write=True)
    seen.camera.matrix[:] = 0.0
    object.__setattr__(seen, "tick", -1)
    object.__setattr__(seen.robot, "v_max_mps", 1e9)


def _forks(seen: Observation) -> None:
    if os.fork() == 0:
        if os.fork() == 0:
            os.setsid()
            time.sleep(3600)
        return  # answers a second time


def _writes_garbage(seen: Observation) -> None:
    for descriptor in range(3, 64):
        try:
            os.write(descriptor, b"\xff" * 4096)
        except OSError:
            continue


def _raises(seen: Observation) -> None:
    raise PolicyServerLost("the server is gone")


DEEDS: dict[str, Callable[[Observation], object]] = {
    "honest": lambda seen: None,
    "patches-the-referee": _patches,
    "peeks": _peeks,
    "scribbles": _scribbles,
    "forks": _forks,
    "floods": lambda seen: [os.write(1, b"x" * (1 << 20)) for _ in range(FLOOD_BYTES >> 20)],
    "goes-elsewhere": lambda seen: os.chdir("/"),
    "closes-descriptors": lambda seen: os.closerange(0, 1024),
    "writes-garbage": _writes_garbage,
    "ends": lambda seen: os._exit(0),
    "pretends": _raises,
    "stops-itself": lambda seen: os.kill(os.getpid(), signal.SIGSTOP),
    "too-many-numbers": lambda seen: np.zeros((50_001, 2)),
    "far-too-many-numbers": lambda seen: np.zeros((1_000_000, 4)),
    "ends-afterwards": lambda seen: None,
    "hangs-afterwards": lambda seen: None,
}
AFTERWARDS: dict[str, Callable[[], object]] = {
    "ends-afterwards": lambda: os._exit(0),
    "hangs-afterwards": lambda: time.sleep(3600),
}
"""What is done when the episode has ended, and the policy knows that."""
