"""Key expressions of the bridge, and valid names in them."""

from __future__ import annotations

import re

from cosim.core.errors import SpecError

_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")


def name(value: str) -> str:
    """Return a valid chunk of a key. Raises SpecError otherwise."""
    if not _NAME.fullmatch(value):
        raise SpecError(
            f"'{value}' cannot name a run or environment: use 1 to 64 of A-Z a-z 0-9 _ -"
        )
    return value


def chunk(value: str) -> str:
    """Convert any name to a chunk of a key; invalid characters become "-"."""
    return name(re.sub(r"[^A-Za-z0-9_-]", "-", value)[:64])


def env(run: str, episode: str) -> str:
    """Return the key prefix of a running episode."""
    return f"cosim/{name(run)}/env/{name(episode)}"


def director(run: str, env: str) -> str:
    """Return the key on which an environment queries the director."""
    return f"cosim/{name(run)}/env/{name(env)}/director"


def job(run: str, act: str) -> str:
    """Return the key on which workers claim or report jobs."""
    return f"cosim/{name(run)}/jobs/{name(act)}"


def worker(run: str, worker: str) -> str:
    """Return the liveliness key of a worker; "*" for any."""
    return f"cosim/{name(run)}/workers/{worker if worker == '*' else name(worker)}"


def status(run: str) -> str:
    """Return the key of the status of a run."""
    return f"cosim/{name(run)}/status"


def net(run: str, digest: str) -> str:
    """Return the key of a street net, by its hash; "*" for any."""
    return f"cosim/{name(run)}/nets/{digest if digest == '*' else name(digest)}"


EVERY_RUN = "cosim/*/status"
"""Key of the status of all runs."""

EVERY_DIRECTOR = "cosim/*/env/*/director"
"""Key of the directors of all running episodes."""

EVERY_STATUS = "cosim/*/env/*/status"
"""Key of the status of all running episodes."""
