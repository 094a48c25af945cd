"""Structured logging of events in a run, a coordinator or a worker."""

from __future__ import annotations

import logging
from typing import Final

LOGGER: Final = logging.getLogger("cosim")
LOGGER.addHandler(logging.NullHandler())
LOGGER.propagate = False


def log_event(event: str, level: int = logging.INFO, /, **facts: object) -> None:
    """Log an event with its facts. Without a log handler this costs next to nothing.

    >>> log_event("retried", logging.WARNING, scenario="frontal-001", why="its worker was lost")
    """
    LOGGER.log(level, event, extra={"facts": facts})
