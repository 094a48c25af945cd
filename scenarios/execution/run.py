"""episode(spec, policy) -> record: the pure function that every worker runs."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import msgspec

from cosim.core.errors import CosimError
from cosim.episode.driver import Driver, said_by
from cosim.episode.loop import steps
from cosim.episode.ports import Policy
from cosim.episode.step import Step
from cosim.judge.event_monitor import Witness, unwitnessed
from cosim.judge.metrics import Episode, measure
from cosim.judge.referee import Failure, Referee, Verdict
from cosim.records.record import Log, Record, Recorder, TriggeredEvent, begun
from cosim.spec.injection import Live
from cosim.spec.scenario import Scenario
from physics.cameras.choice import CameraChoice
from scenarios.execution.assemble import Stage, staged
from scenarios.execution.counterfactual import Beside, Tell, untold
from scenarios.execution.directing import Direct, directed
from scenarios.execution.on_air import OnAir

Watch = Callable[[Step, Verdict], None]


@dataclass(frozen=True)
class Outcome:
    """What came out of an episode. log: None if it crashed before the first tick; traceback: of a crash, or of a
    comparison that failed."""

    record: Record
    log: Log | None
    traceback: str = ""


def episode(
    scenario: Scenario,
    policy: Policy,
    *,
    suite_hash: str = "",
    camera: CameraChoice = "auto",
    watch: Watch | None = None,
    live: Live | None = None,
    direct: Direct = directed,
    counterfactual: bool = False,
    comparing: Tell = untold,
) -> Outcome:
    """Run one scenario to its end. Whatever goes wrong inside becomes a record with status `crashed`.

    live: where it is on the air meanwhile. direct: gives the director of its event pedestrians. counterfactual: whether
    it is compared with its street without the robot; comparing: is told how far that has come.
    """
    began = time.perf_counter()
    driver = Driver.of(policy)
    record = begun(scenario, driver.manifest, suite_hash, driver.source_hash)
    beside, trouble = Beside(), ""
    try:
        with staged(scenario, driver, camera, direct=direct) as stage:
            record = replaced(record, renderer=stage.renderer)
            first_tick_s = time.perf_counter() - began
            with ExitStack() as air:
                watches = [watch] if watch is not None else []
                watches += [beside.watch] if counterfactual else []
                if live is not None:
                    watches.append(air.enter_context(OnAir(live, scenario, stage.guests)).tell)
                record, log = drive(record, scenario, stage, *watches)
    except Exception as error:  # noqa: BLE001  here a failing episode is turned into its record
        return Outcome(replaced(record, status="crashed", reason=in_words(error)), None, traceback.format_exc())
    if counterfactual:
        try:
            measures = record.measures | beside.compared(scenario, stage.entrances, comparing).measures
            record = replaced(record, measures=measures)
        except Exception as error:  # noqa: BLE001  the episode itself is over and sound
            trouble = traceback.format_exc()
            record = replaced(record, reason=f"the street without the robot: {in_words(error)}")
    wall_s = time.perf_counter() - began
    clock = {"wall_s": wall_s, "setup_s": first_tick_s}
    return Outcome(replaced(record, clock=clock), log, trouble)


def in_words(error: Exception) -> str:
    """What a record says of an error: its message, with its type unless the project raised it on purpose."""
    return str(error) if isinstance(error, CosimError) else f"{type(error).__name__}: {said_by(error)}"


def drive(record: Record, scenario: Scenario, stage: Stage, *watches: Watch) -> tuple[Record, Log]:
    """The episode itself, once every engine runs."""
    referee = Referee(scenario, stage.area, stage.parts.world.footprint_m, stage.clock)
    recorder = Recorder(stage.clock.tick_s)
    witness = Witness(scenario, stage.clock.tick_ms)
    failures: list[Failure] = []
    red_lights: list[str] = []
    run = steps(scenario, stage.clock, stage.parts)
    step = next(run)
    while True:
        verdict = referee.judge(step)
        recorder.add(step, verdict, stage.roadway.see(step))
        witness.see(step)
        if verdict.failure is not None:
            failures.append(verdict.failure)
        if verdict.red_light_entry is not None:
            red_lights.append(verdict.red_light_entry)
        for watch in watches:
            watch(step, verdict)
        if verdict.ended is not None:
            break
        step = run.send(verdict.reset)
    run.close()
    log = recorder.log(witness.tracks)
    events = witness.outcomes()
    broken = sum(event.rule_met is False for event in events)
    seen = Episode(log, tuple(failures), len(red_lights), verdict.ended, scenario.route_line.length_m, broken)
    reason = unseen(scenario, events)
    done = replaced(
        record,
        status="invalid" if reason else "done",
        reason=reason,
        ended=verdict.ended,
        ticks=len(log),
        state_hash=recorder.hash.hexdigest(),
        measures=measure(seen),
        failures=tuple(failures),
        events=events,
        injections=stage.guests.log,
    )
    return done, log


def unseen(scenario: Scenario, events: tuple[TriggeredEvent, ...]) -> str:
    """Why an episode that is about its event says nothing about the robot; "" if it does.

    A long way has events that a robot may fail to come to; there this makes nothing invalid.
    """
    if not scenario.ends_on_failure:
        return ""
    reasons = [unwitnessed(event, outcome) for event, outcome in zip(scenario.events, events, strict=True)]
    return "; ".join(filter(None, reasons))


def replaced(record: Record, **changes: Any) -> Record:
    """The record with some fields changed."""
    return msgspec.structs.replace(record, **changes)
