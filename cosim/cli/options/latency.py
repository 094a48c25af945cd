"""Latency on the command line: of every command, given or measured, or as each answer took."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from cosim.cli.terminal.consoles import err
from cosim.cli.terminal.progress import doing
from cosim.core.errors import UsageError
from cosim.core.telling import milliseconds

if TYPE_CHECKING:
    from cosim.spec.options import EpisodeOptions
    from cosim.spec.policy_host import PolicyHost
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
    host: PolicyHost | None = None,
) -> EpisodeOptions:
    """Options with the latency that was asked for; measured by driving `first`, or that of the run that is resumed.
    policy, rate_hz, host: its name, how often it acts, and where. Raises UsageError."""
    from cosim.records.run_folder import read_spec
    from cosim.spec.policy_host import PolicyHost
    from scenarios.execution.suite_run import measured_latency

    latency_ms = asked_latency_ms(asked, real_time)
    if latency_ms is not None:
        return msgspec.structs.replace(options, latency_ms=latency_ms, real_time=real_time)
    if resumed is not None:
        return msgspec.structs.replace(options, latency_ms=read_spec(resumed).latency_ms)
    with doing(f"measuring the latency of {policy} in {first.id}"):
        answer_ms, latency_ms = measured_latency(whole, first, policy, options, host or PolicyHost())
    err.print(
        f"Latency {latency_ms:g} ms, that of every command of this run: in {first.id} an answer took "
        f"{milliseconds(answer_ms)} (median), and commands take effect at whole ticks of 50 ms.",
        soft_wrap=True,
        highlight=False,
    )
    if latency_ms > (period_ms := 1000.0 / rate_hz):
        err.print(
            f"That is longer than its period of {period_ms:g} ms, at which it is asked all the same. With --real-time "
            "it is not asked again before it has answered.",
            soft_wrap=True,
            highlight=False,
        )
    return msgspec.structs.replace(options, latency_ms=latency_ms)


def asked_latency_ms(text: str, real_time: bool) -> float | None:
    """The latency that was asked for, None where it is to be measured before the run. Raises UsageError."""
    from cosim.spec.options import MOST_LATENCY_MS

    if real_time and text:
        raise UsageError("--real-time measures the latency of every answer: leave --latency out")
    if text == "measured":
        return None
    try:
        latency_ms = float(text or "0")
    except ValueError:
        raise UsageError(f"--latency '{text}': give milliseconds, like 200, or 'measured'") from None
    if not 0.0 <= latency_ms <= MOST_LATENCY_MS:
        raise UsageError(f"--latency {text}: milliseconds must be from 0 to {MOST_LATENCY_MS:g}")
    return latency_ms
