"""Running of one episode from start to end, as every worker does it."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec

from bridge.policy_server import error_text
from cosim.core.errors import CosimError, MachineError, RendererLost
from cosim.core.progress import Progress, ignore
from cosim.episode.interfaces import Policy
from cosim.episode.policy_caller import PolicyCaller
from cosim.results.log import Log
from cosim.results.record import Record
from cosim.results.run_setup import RunSetup
from cosim.spec.options import EpisodeOptions, RendererAddress
from cosim.spec.scenario import Scenario
from scenarios.episodes.counterfactual import CounterfactualTracker, DelayComparison
from scenarios.episodes.episode import Episode, Watch
from scenarios.episodes.wiring import StagedScenario
from scenarios.ipc.command_log import CommandLog
from scenarios.ipc.faults import verdict_on


@dataclass(frozen=True)
class Outcome:
    """The result of an episode.

    log: None if the episode crashed.
    traceback: of a crash, or of a failed comparison.
    again: whether an engine failed, so that another attempt may succeed.
    ended_early: whether the caller ended it; its record has no end and no measures.
    """

    record: Record
    log: Log | None
    traceback: str = ""
    again: bool = False
    ended_early: bool = False


def run_episode(
    scenario: Scenario,
    policy: Policy,
    options: EpisodeOptions = EpisodeOptions(),  # noqa: B008  a frozen value
    *,
    setup: RunSetup | None = None,
    renderer: RendererAddress | None = None,
    watches: Sequence[Watch] = (),
    waiting: Progress = ignore,
    comparing: Progress = ignore,
    commands: CommandLog | None = None,
    through: Callable[[StagedScenario], None] | None = None,
    ends_early: Callable[[Episode], bool] | None = None,
) -> Outcome:
    """Run one scenario to its end, and return its record and log.

    An error becomes a record: `crashed` if the policy failed, `invalid` otherwise. An episode whose
    policy server is lost is `crashed` unless it is run again.

    setup, renderer, watches, waiting, commands, through: see `Episode`.
    ends_early: whether to end the episode now, called before each observation.
    comparing: progress callback of the comparison with the street without the robot.
    Raises RendererLost if the shared renderer has ended, MachineError if the machine lacks
    something.
    """
    caller = PolicyCaller.of(policy)
    tracker = CounterfactualTracker()
    all_watches = [*watches, tracker.watch] if options.counterfactual else watches
    if setup is None:
        setup = RunSetup.of(options, policy_source=caller.source_hash, policy_runs=caller.runs)
    episode = Episode(
        scenario,
        caller.manifest,
        options,
        watches=all_watches,
        waiting=waiting,
        setup=setup,
        renderer=renderer,
        commands=commands,
        through=through,
    )
    try:
        with episode:
            drive(episode, caller, ends_early)
            if not episode.over:
                return Outcome(episode.driven(), None, ended_early=True)
            record, log = episode.result()
            record = msgspec.structs.replace(record, clock=record.clock | caller.clock)
            entrances = episode.entrances
    except (RendererLost, MachineError):
        raise
    except Exception as error:  # noqa: BLE001  a failed episode becomes a record
        status, again = verdict_on(error)
        record = driven_so_far(episode)
        record = msgspec.structs.replace(record, status=status, reason=error_message(error))
        return Outcome(record, None, traceback.format_exc(), again)
    finally:
        caller.ended()
    if not options.counterfactual:
        return Outcome(record, log)
    return _compared(
        Outcome(record, log), lambda: tracker.compared(episode.scenario, entrances, comparing)
    )


def _compared(outcome: Outcome, compare: Callable[[], DelayComparison]) -> Outcome:
    """Add the comparison with the street without the robot to an outcome.

    An error of the comparison becomes the record's reason: the episode itself is valid.
    """
    record = outcome.record
    try:
        measures = record.measures | compare().measures
        return replace(outcome, record=msgspec.structs.replace(record, measures=measures))
    except Exception as error:  # noqa: BLE001  the episode itself is valid
        reason = f"the street without the robot: {error_message(error)}"
        record = msgspec.structs.replace(record, reason=reason)
        return replace(outcome, record=record, traceback=traceback.format_exc())


def drive(
    episode: Episode, policy: Policy, ends_early: Callable[[Episode], bool] | None = None
) -> None:
    """Drive an episode to its end with a policy, or until `ends_early` returns True."""
    policy.reset(episode.id, episode.seed)
    observation = episode.reset()
    while not episode.over and not (ends_early is not None and ends_early(episode)):
        observation = episode.advance(policy.act(observation))


def driven_so_far(episode: Episode) -> Record:
    """Return the record of what an episode has driven before an error; its beginning, if the error
    has damaged it."""
    try:
        return episode.driven()
    except Exception:  # noqa: BLE001  a policy in this process may have changed anything
        return episode.record


def error_message(error: Exception) -> str:
    """Return the message of an error, with its type unless it is an error of the project."""
    return (
        str(error)
        if isinstance(error, CosimError)
        else f"{type(error).__name__}: {error_text(error)}"
    )
