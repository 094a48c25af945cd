"""Run folders of made-up episodes on a straight way, without driving."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from cosim.core.clock import Clock
from cosim.core.geometry import Pose
from cosim.episode.loop import place_on_route
from cosim.results.log import Log
from cosim.results.metrics import EpisodeFacts, compute_metrics
from cosim.results.record import Record, TriggeredEvent
from cosim.results.referee import Failure
from cosim.results.run_folder import RunFolder
from cosim.results.walked import walked_m
from cosim.spec.manifest import Manifest
from cosim.spec.robot import robot_called
from cosim.spec.scenario import City, Scenario, Suite
from scenarios.suites.catalog import with_robot, with_weather
from tests.logs import log_with
from tests.run_specs import record_of, spec_of

SPEED_MPS = 1.0
HIT = "hit"
"""Kind of episode that ends half-way by a collision with a wall."""


def short_way(name: str, **fields: object) -> Scenario:
    """Return 9 m straight ahead, over at the first failure or after 12 s."""
    known: dict[str, object] = {
        "id": name,
        "suite": "s",
        "place": City(seed=0),
        "seed": 0,
        "start": (0.0, 0.0, 0.0),
        "goal": (9.0, 0.0),
        "route": ((0.0, 0.0), (9.0, 0.0)),
        "ends_on_failure": True,
        "time_limit_s": 12.0,
        "structure": "straight",
    }
    return Scenario(**known | fields)  # type: ignore[arg-type]


def driven(
    scenario: Scenario, speeds_mps: Sequence[float], resets: dict[int, float] | None = None
) -> Log:
    """Return the log of a robot on the x axis with these speeds, tick by tick; resets: tick -> arc
    length of the reset."""
    tick_s = Clock().tick_s
    count = len(speeds_mps)
    x_m = before_m = 0.0
    pose = np.zeros((count, 3))
    route_s_m = np.zeros(count)
    reset_s_m = np.full(count, np.nan)
    for k, v_mps in enumerate(speeds_mps):
        x_m += v_mps * tick_s
        pose[k, 0] = x_m
        before_m = route_s_m[k] = place_on_route(scenario.route_line, Pose(x_m, 0.0, 0.0), before_m)
        if resets and k in resets:
            x_m = before_m = reset_s_m[k] = resets[k]
    away_m = np.hypot(pose[:, 0] - 4.0, 1.5)
    speeds = np.column_stack([speeds_mps, np.zeros(count)])
    travelled_m = np.abs(speeds_mps) * tick_s
    if cycle_s := robot_called(scenario.robot).drive.cycle_s:
        travelled_m = walked_m(pose[:, :2], reset_s_m, cycle_s / tick_s)
    return log_with(
        count,
        pose=pose,
        speed=speeds,
        command=speeds,
        route_s_m=route_s_m,
        travelled_m=travelled_m,
        person_m=away_m,
        clearance_m=away_m - 0.6,
        collision_in_s=np.full(count, np.inf),
        reset_s_m=reset_s_m,
    )


def failure_at(log: Log, tick: int, kind: str = "collision") -> Failure:
    """Return the log's data of a failure at a tick."""
    x_m, y_m, _ = log.pose[tick].tolist()
    speed_mps = (
        abs(float(log.speed[tick - 1, 0])) if tick and np.isnan(log.reset_s_m[tick - 1]) else 0.0
    )
    other = {"other": "wall", "other_kind": "wall"} if kind == "collision" else {}
    return Failure(kind, tick, x_m, y_m, float(log.route_s_m[tick]), speed_mps, **other)  # type: ignore[arg-type]


def episode_of(
    scenario: Scenario, suite_hash: str, how: str = "goal", policy: str = "p"
) -> tuple[Record, Log | None]:
    """Return the record and log of a short way. how: "goal"; HIT; "crashed"; "invalid"."""
    record = record_of(scenario, Manifest(policy, camera=None), suite_hash=suite_hash)
    if how in ("crashed", "invalid"):
        return msgspec.structs.replace(record, status=how, reason="it said so"), None
    complete_log = driven(scenario, [SPEED_MPS] * 161)
    ticks = int(np.argmax(complete_log.pose[:, 0] >= 8.0)) + 1 if how == "goal" else 80
    log = driven(scenario, [SPEED_MPS] * ticks)
    failures = (failure_at(log, ticks - 1),) if how == HIT else ()
    ended = "goal" if how == "goal" else "failure"
    record = msgspec.structs.replace(
        record,
        status="done",
        ended=ended,
        ticks=ticks,
        failures=failures,
        events=tuple(
            TriggeredEvent(
                id=event.id,
                kind=event.kind,
                passed=False,
                triggered_at_s=0.0 if how == "goal" else None,
                seen=how == "goal",
            )
            for event in scenario.events
        ),
    )
    return msgspec.structs.replace(
        record, measures=compute_metrics(EpisodeFacts.of(record, scenario, log))
    ), log


def with_decoys(*ways: Scenario) -> tuple[Scenario, ...]:
    """Return scenarios, each followed by its decoy."""
    return tuple(
        one
        for way in ways
        for one in (
            way,
            msgspec.structs.replace(way, id=f"{way.id}-decoy", decoy_of=way.id, go_on_mps=0.5),
        )
    )


def run_of(
    path: Path,
    hows: Sequence[str],
    policy: str = "p",
    scenarios: Sequence[Scenario] = (),
    robot: str = "",
    weather: str = "",
    gait: str = "",
) -> Path:
    """Write a finished run of short ways, each as `episode_of` makes it, with ids s-000, s-001 and
    so on. robot, weather: applied to the scenarios, as by `--robot`; gait: as by `--gait`."""
    ways = tuple(scenarios) or tuple(short_way(f"s-{i:03d}") for i in range(len(hows)))
    suite = Suite(name=ways[0].suite, version="1", scenarios=ways)
    of_run = with_weather(with_robot(suite, robot), weather)
    robots = {way.robot: "h" for way in of_run.scenarios}
    spec = msgspec.structs.replace(spec_of(suite, policy), robots=robots, weather=weather)
    of_gait = {"gait": gait, "gait_hash": "0123456789abcdef" if gait else ""}
    spec = msgspec.structs.replace(spec, setup=msgspec.structs.replace(spec.setup, **of_gait))
    with RunFolder.create(path, spec, of_run) as folder:
        for way, how in zip(of_run.scenarios, hows, strict=True):
            record, log = episode_of(way, suite.content_hash, how, policy)
            setup = msgspec.structs.replace(record.setup, **of_gait)
            record = msgspec.structs.replace(record, setup=setup)
            folder.write_episode(record, log.encoded() if log is not None else b"")
        folder.finish()
    return path
