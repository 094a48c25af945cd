"""Replay of a failed episode without its policy, to find out whether the simulator is at fault."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from cosim.core.errors import MachineError, PolicyError
from cosim.core.progress import Progress, ignore
from cosim.results.record import Record
from cosim.results.run_setup import RunSetup
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions, RendererAddress
from cosim.spec.scenario import Scenario
from scenarios.episodes.counterfactual import CounterfactualTracker
from scenarios.episodes.episode import Episode, Watch
from scenarios.episodes.run_episode import driven_so_far, error_message
from scenarios.ipc.command_log import CommandLog, TimedCommand


class Replayed(NamedTuple):
    """The result of a replay.

    record: what was driven.
    error: message of the engine error that ended it, "" if the simulator survived the commands.
    """

    record: Record
    error: str = ""


def repeat_commands(
    scenario: Scenario,
    manifest: Manifest,
    commands: Iterable[TimedCommand],
    options: EpisodeOptions = EpisodeOptions(),  # noqa: B008  a frozen value
    *,
    setup: RunSetup | None = None,
    renderer: RendererAddress | None = None,
    log: CommandLog | None = None,
    watches: Sequence[Watch] = (),
    waiting: Progress = ignore,
) -> Replayed:
    """Simulate the commands of an episode without its policy, with the same sensors.

    manifest: of the policy.
    commands: from the episode's command log, up to its failure.
    log: log of the commands that are simulated again.
    setup, renderer, watches, waiting: see `Episode`.
    Raises MachineError if the machine lacks something.
    """
    tracker = CounterfactualTracker()
    watches = [*watches, tracker.watch] if options.counterfactual else watches
    episode = Episode(
        scenario,
        manifest,
        options,
        watches=watches,
        waiting=waiting,
        setup=setup,
        renderer=renderer,
        commands=log,
    )
    try:
        with episode:
            episode.reset()
            for one in commands:
                if not episode.over:
                    episode.advance(one.command, delay=one.delay)
            record = episode.result()[0] if episode.over else episode.driven()
            entrances = episode.entrances
        if episode.over and options.counterfactual:
            tracker.compared(episode.scenario, entrances, waiting)
    except MachineError:
        raise
    except PolicyError:  # no number: a policy has written to the log
        return Replayed(driven_so_far(episode))
    except Exception as error:  # noqa: BLE001  reported, to be compared with the failure
        return Replayed(driven_so_far(episode), error_message(error))
    return Replayed(record)
