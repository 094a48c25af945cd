"""Latency on the command line: of every command, given or measured, or as each answer took."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from cosim.cli.terminal.consoles import err
from cosim.cli.terminal.progress import doing
from cosim.core.errors import UsageError

if TYPE_CHECKING:
    from cosim.spec.options import EpisodeOptions
    from cosim.spec.scenario import Scenario, Suite

LATENCY_HELP = (
    "Milliseconds from an observation until the command that answers it takes effect, rounded up to ticks of 50 ms; or "
    "'measured': the median that the policy shows here in the first episode, driven once before the run."
)
REAL_TIME_HELP = (
    "Each answer takes effect as late as it came on this machine. One process; does not come again from its seed."
)


def with_latency(
    options: EpisodeOptions,
    asked: str,
    real_time: bool,
    resumed: Path | None,
    whole: Suite,
    first: Scenario,
    policy: str,
    rate_hz: float,
) -> EpisodeOptions:
    """Options with the latency that was asked for; measured by driving `first`, or that of the run that is resumed.
    policy, rate_hz: its name, and how often it acts. Raises UsageError."""
    from cosim.records.run_folder import read_spec
    from scenarios.execution.suite_run import measured_latency_ms

    if real_time and asked:
        raise UsageError("--real-time measures the latency of every answer: leave --latency out")
    if asked != "measured":
        return msgspec.structs.replace(options, latency_ms=_milliseconds(asked or "0"), real_time=real_time)
    if resumed is not None:
        return msgspec.structs.replace(options, latency_ms=read_spec(resumed).latency_ms)
    with doing(f"measuring the latency of {policy} in {first.id}"):
        latency_ms = measured_latency_ms(whole, first, policy, options)
    err.print(f"Latency {latency_ms:g} ms, measured in {first.id}: that of every command of this run.", highlight=False)
    if latency_ms > (period_ms := 1000.0 / rate_hz):
        err.print(
            f"That is longer than its period of {period_ms:g} ms, at which it is asked all the same. With --real-time "
            "it is not asked again before it has answered.",
            soft_wrap=True,
            highlight=False,
        )
    return msgspec.structs.replace(options, latency_ms=latency_ms)


def _milliseconds(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"--latency '{text}': give milliseconds, like 200, or 'measured'") from None
