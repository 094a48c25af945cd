"""Scorer: passes the Steps of an episode to referee, recorder and monitors."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from cosim.core.clock import Clock
from cosim.core.errors import UsageError
from cosim.episode.command_delay import CommandDelay, median_ms
from cosim.episode.loop import Step
from cosim.place.street_map import StreetMap, WalkableArea
from cosim.results.event_monitor import EventMonitor, OcclusionTest
from cosim.results.log import Log
from cosim.results.metrics import BRIEF, BRIEF_COLUMNS, METRICS, EpisodeFacts, compute_metrics
from cosim.results.record import Record, Recorder, RedLightEntry, Status
from cosim.results.referee import Failure, Referee, Verdict
from cosim.results.traffic import TrafficMonitor
from cosim.results.validity import why_bypassed, why_invalid
from cosim.spec.events import EventKinds
from cosim.spec.robot import Robot
from cosim.spec.scenario import Scenario


class Scorer:
    """Referee, recorder and monitors of one episode.

    kinds: table of event kinds.
    area: where the robot may drive.
    occluded: see `EventMonitor`.
    """

    def __init__(
        self,
        scenario: Scenario,
        kinds: EventKinds,
        street_map: StreetMap,
        area: WalkableArea,
        robot: Robot,
        occluded: OcclusionTest,
        clock: Clock,
    ) -> None:
        self._scenario = scenario
        self._clock = clock
        footprint_m = self._footprint_m = robot.footprint_m
        self._referee = Referee(scenario, area, footprint_m, clock)
        self._cycle_s = robot.drive.cycle_s
        self._recorder = Recorder(clock.tick_s, footprint_m, cycle_s=self._cycle_s)
        self._monitor = EventMonitor(scenario, kinds, robot, occluded, clock.tick_ms)
        self._traffic = TrafficMonitor(street_map, clock.tick_s)
        self._failures: list[Failure] = []
        self._walked_into: list[Failure] = []
        self._red_lights: list[RedLightEntry] = []
        self._verdict = Verdict()
        self._measures: Sequence[str] = tuple(METRICS)
        self._hashes = False

    def skip_measures(self) -> None:
        """Record nothing from now on, so that there is no result. Only the referee continues."""
        self._measures = ()

    def only_hash(self) -> None:
        """Record only the state hash, so that there is no result. Call it before the first Step."""
        self._measures, self._hashes = (), True
        self._recorder = Recorder(self._clock.tick_s, self._footprint_m, ())

    def measure_briefly(self) -> None:
        """Record only what the measures of a search need. Call it before the first Step."""
        self._measures = BRIEF
        self._recorder = Recorder(
            self._clock.tick_s, self._footprint_m, BRIEF_COLUMNS, self._cycle_s
        )

    @property
    def is_lost(self) -> bool:
        """Return whether the episode fails or breaks a rule, whatever follows."""
        return bool(self._failures) or self._monitor.rule_is_broken

    @property
    def state_hash(self) -> str:
        """Return the hash of the simulated states so far."""
        return self._recorder.hash.hexdigest()

    def score(self, step: Step) -> Verdict:
        """Return the referee's verdict on the next Step, and record both."""
        verdict = self._verdict = self._referee.judge(step)
        if not self._measures:
            if self._hashes:
                self._recorder.add(step, verdict)
            return verdict
        self._recorder.add(step, verdict, self._traffic.update(step))
        self._monitor.update(step)
        self._failures += verdict.failures
        self._walked_into += verdict.walked_into
        if verdict.red_light_entry is not None:
            self._red_lights.append(RedLightEntry(step.tick, verdict.red_light_entry))
        return verdict

    def driven(self, begun: Record) -> Record:
        """Return the record with what was driven so far, without an end and measures."""
        return msgspec.structs.replace(
            begun,
            ticks=self._recorder.ticks,
            state_hash=self.state_hash,
            failures=tuple(self._failures),
            walked_into=tuple(self._walked_into),
            red_light_entries=tuple(self._red_lights),
            events=self._monitor.outcomes(self._verdict.ended),
        )

    def result(self, begun: Record, commands: CommandDelay) -> tuple[Record, Log]:
        """Return the completed record, and the log.

        begun: the record from the start of the episode.
        commands: all answers of the policy.
        Raises UsageError after `skip_measures` and `only_hash`.
        """
        if not self._measures:
            raise UsageError("this episode recorded no measures: it has no result")
        scenario = self._scenario
        log = self._recorder.log(self._monitor.tracks, commands)
        setup = begun.setup
        if setup.real_time:
            setup = msgspec.structs.replace(
                setup, latency_ms=median_ms(log.answers, self._clock.tick_ms)
            )
        driven = self.driven(begun)
        record = msgspec.structs.replace(driven, ended=self._verdict.ended, setup=setup)
        measures = compute_metrics(EpisodeFacts.of(record, scenario, log), self._measures)
        invalid = why_invalid(record, scenario)
        status: Status = "invalid" if invalid else "done"
        reason = invalid or why_bypassed(record, scenario)
        return msgspec.structs.replace(record, status=status, reason=reason, measures=measures), log
