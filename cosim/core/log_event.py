"""What happens in a run, a coordinator or a worker, for logs: an event by its name, and facts by
theirs."""

from __future__ import annotations

import logging
from typing import Final

JOURNAL: Final = logging.getLogger("cosim")
JOURNAL.addHandler(logging.NullHandler())
JOURNAL.propagate = False


def happened(event: str, level: int = logging.INFO, /, **facts: object) -> None:
    """Tell whoever keeps a log. Nothing is kept, and next to nothing done, where nobody does.

    >>> happened("retried", logging.WARNING, scenario="frontal-001", why="its worker was lost")
    """
    JOURNAL.log(level, event, extra={"facts": facts})
