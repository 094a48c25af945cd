"""Key expressions of the bridge, and the names that may stand in them."""

from __future__ import annotations

import re

from cosim.core.errors import SpecError

_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")


def name(value: str) -> str:
    """`value` if it may be one chunk of a key. Raises SpecError otherwise."""
    if not _NAME.fullmatch(value):
        raise SpecError(
            f"'{value}' cannot name a run or environment: use 1 to 64 of A-Z a-z 0-9 _ -"
        )
    return value


def chunk(value: str) -> str:
    """Any name made fit to stand in a key: what may not stand there becomes "-"."""
    return name(re.sub(r"[^A-Za-z0-9_-]", "-", value)[:64])


def env(run: str, episode: str) -> str:
    """What all keys of one running episode begin with."""
    return f"cosim/{name(run)}/env/{name(episode)}"


def director(run: str, env: str) -> str:
    """Where the simulator of one environment asks for the event pedestrians of a tick."""
    return f"cosim/{name(run)}/env/{name(env)}/director"


def job(run: str, act: str) -> str:
    """Where workers of a run do this with its jobs: claim, report."""
    return f"cosim/{name(run)}/jobs/{name(act)}"


def worker(run: str, worker: str) -> str:
    """Where a worker of a run is seen to be there; "*" for any."""
    return f"cosim/{name(run)}/workers/{worker if worker == '*' else name(worker)}"


def status(run: str) -> str:
    """Where a run's coordinator tells how it goes."""
    return f"cosim/{name(run)}/status"


def net(run: str, digest: str) -> str:
    """Where a run's coordinator hands out a street net, by its hash; "*" for any."""
    return f"cosim/{name(run)}/nets/{digest if digest == '*' else name(digest)}"


EVERY_RUN = "cosim/*/status"
"""Asked, the coordinator of a run answers."""

EVERY_DIRECTOR = "cosim/*/env/*/director"
"""What a director of any run answers."""

EVERY_STATUS = "cosim/*/env/*/status"
"""Asked, every running episode answers."""
