"""Episode: one run of a scenario, advanced by one period of the policy at a time.

    with Episode(scenario, policy.manifest) as episode:
        policy.reset(episode.id, episode.seed)
        observation = episode.reset()
        while not episode.over:
            observation = episode.advance(policy.act(observation))
    record, log = episode.result()

Runs, films, replays, measurements and Gymnasium environments all use it. The policy is not part of
it.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from types import TracebackType
from typing import Self

import msgspec

from cosim.core.clock import Clock, Pacer
from cosim.core.errors import EngineError, PolicyError, UsageError
from cosim.core.progress import Progress, ignore
from cosim.core.state import Frame
from cosim.episode.command_delay import CommandDelay, whole_ticks
from cosim.episode.control import command_of
from cosim.episode.interfaces import Observation, ViewCamera
from cosim.episode.loop import Moment, Step, after, begin, tick
from cosim.episode.manifest_checks import check_camera, with_goal
from cosim.results.log import Log
from cosim.results.record import Record
from cosim.results.referee import Verdict
from cosim.results.run_setup import RunSetup
from cosim.spec.camera import CameraSpec
from cosim.spec.episode_id import episode_id_of
from cosim.spec.events import EventKinds
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions, RendererAddress
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Scenario
from scenarios.episodes.live_episode import LiveEpisode
from scenarios.episodes.wiring import StagedScenario, staged
from scenarios.events import EVENT_KINDS
from scenarios.ipc.command_log import CommandLog, TimedCommand
from sumo_nets.crowd.demand_log import Entrances

Watch = Callable[[Step, Verdict], None]
"""Callback for each Step of an episode and the referee's verdict on it."""


_engines_ran_in: set[int] = set()
"""Ids of this process and of its ancestors by fork in which engines have run."""


class Episode:
    """One episode of a scenario, for a policy with this manifest.

    Use it in a `with` block: its engines start on entering, and are always closed. A process can
    run one episode at a time, because SUMO runs once in each process.

    id, seed: arguments of the policy's `reset`.
    watches: called at every tick.
    waiting: called when the episode waits for another process.
    through: may wrap the engines, after they are started and before the first tick.
    kinds: table of valid event kinds.
    setup: of the run, with seed and latency; by default derived from the options.
    renderer: shared renderer of the run, used in place of an own camera.
    commands: log of each command before it is simulated.

    Raises UsageError for a camera that the robot lacks, for a goal that the policy does not
    support, for a gait whose files differ from the set-up's, and for calls in the wrong order.
    Raises PolicyError for an invalid command, EngineError when an engine fails or runs already, and
    the errors of loading its place.

    >>> from cosim import load_policy, load_suite
    >>> policy = load_policy("straight")
    >>> with Episode(load_suite("reactive").scenarios[0], policy.manifest) as episode:
    ...     observation = episode.reset()
    ...     while not episode.over:
    ...         observation = episode.advance(policy.act(observation))
    >>> record, log = episode.result()
    >>> record.ended, len(log) == record.ticks
    ('failure', True)
    """

    def __init__(
        self,
        scenario: Scenario,
        manifest: Manifest,
        options: EpisodeOptions = EpisodeOptions(),  # noqa: B008  a frozen value
        *,
        watches: Sequence[Watch] = (),
        waiting: Progress = ignore,
        through: Callable[[StagedScenario], None] | None = None,
        kinds: EventKinds = EVENT_KINDS,
        setup: RunSetup | None = None,
        renderer: RendererAddress | None = None,
        commands: CommandLog | None = None,
    ) -> None:
        self.scenario = scenario = options.apply_to(scenario)
        manifest = with_goal(manifest, options.goal)
        self.manifest = manifest
        self.options = options
        check_camera(manifest, robot_called(scenario.robot), options.own_camera)
        self.setup = setup or RunSetup.of(options)
        self.id, self.seed = episode_id_of(self.setup.seed, scenario)
        self.clock = Clock.for_rate(manifest.rate_hz)
        self.record = Record.begun(scenario, manifest, self.setup)
        self._renderer = renderer
        self._command_log = commands
        self._watches = list(watches)
        self._waiting = waiting
        self._through = through
        self._kinds = kinds
        self._began_s = time.perf_counter()
        self._setup_s = 0.0
        self._stack = ExitStack()
        self._stage: StagedScenario | None = None
        self._now: Moment | None = None
        self._frame: Frame | None = None
        self._verdict = Verdict()
        self._was_reset = False
        self._commands = CommandDelay()
        self._asked_s = 0.0
        self._took_ms: list[float] = []
        self._result: tuple[Record, Log] | None = None

    def __enter__(self) -> Self:
        if self._setup_s:
            raise UsageError(
                "this Episode was used before: make a new Episode for every run of a scenario"
            )
        if _engines_ran_in - {os.getpid()}:
            raise EngineError(
                "engines ran in the process that this one was forked from, whose threads are not "
                "here: start processes by 'forkserver' or 'spawn' (context= of AsyncVectorEnv, "
                "start_method= of SubprocVecEnv)"
            )
        _engines_ran_in.add(os.getpid())
        with ExitStack() as stack:
            stage = stack.enter_context(
                staged(
                    self.scenario,
                    self.manifest,
                    self.options,
                    self.setup.seed,
                    self.clock,
                    self._waiting,
                    self._kinds,
                    self._renderer,
                )
            )
            self._check_gait(stage.gait_hash)
            if self._through is not None:
                self._through(stage)
            if self.options.live is not None:
                live = stack.enter_context(
                    LiveEpisode(self.options.live, self.scenario, stage.injected)
                )
                self._watches.append(live.publish)
            if self.options.pace:
                pacer = Pacer(self.options.pace)
                self._watches.append(lambda step, verdict: pacer.wait(self.clock.tick_s))
            self._stack = stack.pop_all()
        self._stage = stage
        self._scorer = stage.scorer
        self._injected = stage.injected
        setup = msgspec.structs.replace(
            self.setup, renderer=stage.renderer, gait_hash=stage.gait_hash
        )
        self.record = msgspec.structs.replace(self.record, setup=setup, scan=stage.scan)
        self._setup_s = time.perf_counter() - self._began_s
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self.close()

    def _check_gait(self, found: str) -> None:
        """Raise UsageError if the files of the gait have another hash than those of the set-up."""
        recorded = self.setup.gait_hash
        if recorded not in ("", found):
            raise UsageError(
                f"gait '{self.setup.gait}': its files have hash {found}, and recorded is "
                f"{recorded}: restore the files, or begin another run"
            )

    def close(self) -> None:
        """Close all engines; a second call does nothing. `result` remains available."""
        self._stack.close()
        self._stage = None

    def watch(self, watch: Watch) -> None:
        """Add a callback for all further ticks."""
        self._watches.append(watch)

    @property
    def over(self) -> bool:
        """Return whether the referee has ended the episode."""
        return self._verdict.ended is not None

    @property
    def time_s(self) -> float:
        """Return the simulated seconds since the start."""
        return 0.0 if self._now is None else self.clock.time_s(self._now.tick)

    @property
    def moment(self) -> Moment:
        """Return the current state."""
        return self._begun[1]

    @property
    def footprint_m(self) -> tuple[float, float]:
        """Return length and width of the robot."""
        return self._open.engines.world.footprint_m

    @property
    def entrances(self) -> Entrances:
        """Return the arrivals and departures of the crowd so far."""
        return self._open.entrances

    @property
    def state_hash(self) -> str:
        """Return the hash of the simulated states so far."""
        return self._open.scorer.state_hash

    def eyes(self, spec: CameraSpec) -> AbstractContextManager[ViewCamera]:
        """Create a further camera, for viewing."""
        return self._open.eyes(spec)

    def reset(self) -> Observation:
        """Start the episode and return the first observation. Raises UsageError on a second
        call."""
        stage = self._open
        if self._now is not None:
            raise UsageError(
                "this Episode has begun: an episode cannot be begun again, make another "
                "Episode for that"
            )
        self._now = begin(self.scenario, stage.engines)
        return self._observe(stage, self._now, True)

    def advance(
        self, answer: object, *, until_tick: int | None = None, delay: int | None = None
    ) -> Observation:
        """Simulate one period of the policy with its answer, and return the next observation.

        In real time it also simulates until the answer has arrived. Its latency is the time since
        the last observation was returned.

        answer: a Command or waypoints; see `cosim.episode.control.command_of`.
        until_tick: return at this tick within the period, for viewing.
        delay: ticks until the answer takes effect, for a replay; by default from the latency.
        """
        took_ms = 1000.0 * (time.perf_counter() - self._asked_s)
        stage, now = self._begun
        if self.over:
            raise UsageError(
                f"this Episode is over ({self._verdict.ended}): ask for its result(), or "
                f"make another"
            )
        try:
            command = command_of(answer, rule=self.manifest.waypoints, robot=stage.robot)
        except PolicyError as error:
            raise PolicyError(f"policy '{self.manifest.name}' {error}") from error
        setup, frame = self.setup, self._frame
        latency_ms = took_ms if setup.real_time else setup.latency_ms
        self._took_ms.append(took_ms)
        if delay is None:
            delay = whole_ticks(latency_ms, self.clock.tick_ms)
        self._commands.add(now.tick, delay, command)
        if self._command_log is not None:
            self._command_log.commanded(TimedCommand(now.tick, delay, command))
        free_again = self._commands.last_arrival_tick if setup.real_time else 0
        while True:
            step = tick(
                self.scenario, self.clock, stage.engines, now, self._commands.at(now.tick), frame
            )
            self._verdict = verdict = stage.scorer.score(step)
            for watch in self._watches:
                watch(step, verdict)
            self._now = now = after(step, verdict.reset, stage.engines)
            self._was_reset |= verdict.reset is not None
            stage.observer.moved(step, verdict.reset is not None)
            if verdict.reset is not None:
                self._commands.on_reset()
            asks = self.clock.acts(now.tick) and now.tick >= free_again
            if self.over or asks or now.tick == until_tick:
                return self._observe(stage, now, asks)
            frame = None

    def result(self) -> tuple[Record, Log]:
        """Return the record and the log. Raises UsageError before the episode is over."""
        if not self.over:
            raise UsageError(
                "this Episode is not over: advance() it until `over`, then ask for its result()"
            )
        if self._result is None:
            record, log = self._scorer.result(self.record, self._commands)
            clock = {"wall_s": time.perf_counter() - self._began_s, "setup_s": self._setup_s}
            if self._took_ms:
                clock["answer_ms"] = statistics.median(self._took_ms)
            self._result = (
                msgspec.structs.replace(record, injections=self._injected.log, clock=clock),
                log,
            )
        return self._result

    def driven(self) -> Record:
        """Return the record of what was driven so far, without measures."""
        if self._now is None or self._now.tick == 0:
            return self.record
        record = self._scorer.driven(self.record)
        return msgspec.structs.replace(record, injections=self._injected.log)

    def _observe(self, stage: StagedScenario, now: Moment, asks: bool) -> Observation:
        """Return the current observation. asks: whether it goes to the policy."""
        was_reset = self._was_reset
        self._was_reset = was_reset and not asks
        time_s = self.clock.time_s(now.tick)
        camera = stage.engines.camera
        seen, self._frame = stage.observer.observed(now, time_s, camera, was_reset)
        self._asked_s = time.perf_counter()
        return seen

    @property
    def _open(self) -> StagedScenario:
        if self._stage is None:
            what = (
                "is closed: make another Episode"
                if self._setup_s
                else "has not been entered: use it in a `with` block"
            )
            raise UsageError(f"this Episode {what}")
        return self._stage

    @property
    def _begun(self) -> tuple[StagedScenario, Moment]:
        stage = self._open
        if self._now is None:
            raise UsageError(
                "this Episode has not begun: call reset() first, it gives the first observation"
            )
        return stage, self._now
