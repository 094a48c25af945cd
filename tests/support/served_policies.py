"""Policies that are served from processes of their own, with no cosim: run as a script, beside a
copy of policy_server.

python served_policies.py CLASS NAME ENDPOINT
"""

import os
import signal
import sys
import time
from pathlib import Path
from typing import ClassVar


class Steady:
    """Drives by the brightness of its picture, as tests.support.hostile:Honest does."""

    manifest: ClassVar = {
        "name": "honest",
        "rate_hz": 4.0,
        "camera": {"width": 64, "height": 40},
        "goal": "route_patch",
        "odometry": "wheel",
    }

    def reset(self, episode_id, seed):
        self.count = 0

    def act(self, seen):
        self.count += 1
        assert seen.rgb.shape == (40, 64, 3) and seen.camera.matrix.shape == (3, 3)
        assert seen.goal.pixels.shape == (80, 80) and seen.odometry.heading_rad is not None
        return {"v_mps": 1.0 + float(seen.rgb.mean()) / 1e4, "w_radps": 0.0}


class Dying(Steady):
    """Kills its process at the third query of an episode, except the second time; its fifth query
    is never answered."""

    def act(self, seen):
        answer = super().act(seen)
        if self.count == 3:
            with Path("thirds").open("a") as thirds:
                thirds.write(".")
            size = Path("thirds").stat().st_size
            if size in (1, 3, 4):
                os.kill(os.getpid(), signal.SIGKILL)
            if size == 5:
                time.sleep(3600)
        return answer


class Stuck(Steady):
    """Never answers a query."""

    def act(self, seen):
        Path("asked").touch()
        time.sleep(3600)


if __name__ == "__main__":
    from policy_server import serve

    sys.stdout.reconfigure(line_buffering=True)
    _, kind, called, endpoint = sys.argv
    serve(globals()[kind], name=called, listen=endpoint)
