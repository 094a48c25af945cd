"""run_episode(scenario, policy, options) -> outcome: the pure function that every worker runs."""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from bridge.policy_server import said_by
from cosim.core.errors import CosimError, MachineError, RendererLost
from cosim.core.progress import Progress, ignore
from cosim.episode.interfaces import Policy
from cosim.episode.policy_caller import Driver
from cosim.results.log import Log
from cosim.results.record import Record
from cosim.results.run_setup import RunSetup
from cosim.spec.options import EpisodeOptions, RendererAt
from cosim.spec.scenario import Scenario
from scenarios.episodes.counterfactual import Beside
from scenarios.episodes.episode import Episode, Watch
from scenarios.ipc.faults import verdict_on


@dataclass(frozen=True)
class Outcome:
    """What came out of an episode. log: None if it crashed; traceback: of a crash, or of a
    comparison that failed; again: an engine failed, which may not happen another time."""

    record: Record
    log: Log | None
    traceback: str = ""
    again: bool = False


def run_episode(
    scenario: Scenario,
    policy: Policy,
    options: EpisodeOptions = EpisodeOptions(),  # noqa: B008  a frozen value
    *,
    setup: RunSetup | None = None,
    renderer: RendererAt | None = None,
    watches: Sequence[Watch] = (),
    waiting: Progress = ignore,
    comparing: Progress = ignore,
) -> Outcome:
    """Run one scenario to its end. Whatever goes wrong inside becomes a record, `crashed` where it
    was the policy, `invalid` where it was anything else; but for a shared renderer that has ended:
    then it raises RendererLost, and is to be run again; and for what the machine lacks:
    MachineError, which is no episode's fault. One whose policy server is gone is to be run again,
    and has crashed if it is not.

    setup, renderer, watches, waiting: see `Episode`.
    comparing: receives how far the comparison with the street without the robot has come.
    """
    driver = Driver.of(policy)
    beside = Beside()
    trouble = ""
    listening = [*watches, beside.watch] if options.counterfactual else watches
    if setup is None:
        setup = RunSetup.of(options, policy_source=driver.source_hash, policy_runs=driver.runs)
    episode = Episode(
        scenario,
        driver.manifest,
        options,
        watches=listening,
        waiting=waiting,
        setup=setup,
        renderer=renderer,
    )
    try:
        with episode:
            drive(episode, driver)
            record, log = episode.result()
            record = msgspec.structs.replace(record, clock=record.clock | driver.clock)
            entrances = episode.entrances
    except (RendererLost, MachineError):
        raise
    except Exception as error:  # noqa: BLE001  here a failing episode is turned into its record
        status, again = verdict_on(error)
        record = msgspec.structs.replace(episode.record, status=status, reason=in_words(error))
        return Outcome(record, None, traceback.format_exc(), again)
    finally:
        driver.ended()
    if options.counterfactual:
        try:
            measures = (
                record.measures | beside.compared(episode.scenario, entrances, comparing).measures
            )
            record = msgspec.structs.replace(record, measures=measures)
        except Exception as error:  # noqa: BLE001  the episode itself is over and sound
            trouble = traceback.format_exc()
            record = msgspec.structs.replace(
                record, reason=f"the street without the robot: {in_words(error)}"
            )
    return Outcome(record, log, trouble)


def drive(episode: Episode, policy: Policy) -> None:
    """Let a policy drive an episode to its end."""
    policy.reset(episode.id, episode.seed)
    observation = episode.reset()
    while not episode.over:
        observation = episode.advance(policy.act(observation))


def in_words(error: Exception) -> str:
    """What a record says of an error: its message, with its type unless the project raised it on
    purpose."""
    return (
        str(error) if isinstance(error, CosimError) else f"{type(error).__name__}: {said_by(error)}"
    )
