"""`--pace`: an episode waits for the wall clock, and nothing in it changes."""

from __future__ import annotations

from functools import partial

import msgspec
import pytest

from cosim.core.clock import Clock, Pacer
from cosim.core.errors import UsageError
from cosim.policies.load import load_policy
from cosim.spec.options import EpisodeOptions
from scenarios.episodes import episode
from scenarios.episodes.run_episode import run_episode
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import Cosim


@pytest.mark.engine
def test_a_pace_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """At half of real time a second of an episode takes two, and comes to the same state hash as
    without a pace."""
    slept_s: list[float] = []
    monkeypatch.setattr(
        episode, "Pacer", partial(Pacer, clock=lambda: 100.0 + sum(slept_s), sleep=slept_s.append)
    )
    short = msgspec.structs.replace(small_scenario(), time_limit_s=1.0)
    free = run_episode(short, load_policy("straight")).record
    assert not slept_s
    held = run_episode(short, load_policy("straight"), EpisodeOptions(pace=0.5)).record
    assert sum(slept_s) == pytest.approx(2.0 * Clock().time_s(held.ticks)) and held.ticks >= 20
    assert held.state_hash == free.state_hash != ""
    assert msgspec.structs.replace(held, clock={}) == msgspec.structs.replace(free, clock={})


@pytest.mark.parametrize("pace", ["-1", "nan", "inf", "0.01", "1000"])
def test_a_pace_that_makes_no_sense_is_refused(pace: str, cosim: Cosim) -> None:
    """By the command line and from Python, with what was found and what is valid."""
    words = "pace must be from 0.1 to 100 times real time, or 0 for as fast as possible, not"
    with pytest.raises(UsageError, match=words):
        EpisodeOptions(pace=float(pace))
    refused = cosim("run", "reactive", "--policy", "stop", f"--pace={pace}")
    assert refused.returncode == 2 and f"{words} {pace}" in refused.stderr
