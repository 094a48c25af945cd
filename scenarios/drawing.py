"""Drawing scenarios from a seed until one fits its place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from cosim.errors import CosimError, SpecError
from cosim.scenario import Scenario

TRIES: Final = 400


def first_that_fits(draw: Callable[[], Scenario], failure: str) -> Scenario:
    """The first of TRIES draws that is not refused. Raises SpecError, `failure` and how often each reason was given."""
    refusals: dict[str, int] = {}
    for _ in range(TRIES):
        try:
            return draw()
        except CosimError as refusal:
            reason = str(refusal).split(":")[0]
            refusals[reason] = refusals.get(reason, 0) + 1
    told = "; ".join(f"{reason} ({n} times)" for reason, n in sorted(refusals.items(), key=lambda r: -r[1]))
    raise SpecError(f"{failure} in {TRIES} draws: {told}")
