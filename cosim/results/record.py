"""One episode on disk: `record.json` (what came out) and `trajectory.npz` (what happened, tick by
tick).

Everything in a record but its `clock` part is a function of scenario, policy and versions: two runs
give the same bytes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from cosim.core.errors import RunError, SpecError
from cosim.core.files import read_within, write_atomic
from cosim.core.geometry import Floats
from cosim.core.versions import versions
from cosim.episode.camera_rules import nonstandard
from cosim.episode.command_delay import InFlight
from cosim.episode.step import Step
from cosim.results.log import COLUMNS, Log, Tick
from cosim.results.referee import Failure, Verdict
from cosim.results.traffic import OnRoad
from cosim.spec.camera import CameraSpec
from cosim.spec.episode_id import pseudonym_of
from cosim.spec.injection import Injected
from cosim.spec.manifest import Manifest, WaypointRule
from cosim.spec.odometry import OdometryKind
from cosim.spec.policy_host import PolicyRuns
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Scenario, Split, content_hash

_SCHEMA = 1
_MOST_BYTES = 256 << 20
METRIC_SCHEMA = 3
"""Raised whenever a definition of `cosim.results.metrics` comes or changes; other schemas are not
compared with it."""
NO_RENDERER = "none"
"""The renderer of an episode whose policy has no camera."""

Status = Literal["done", "crashed", "invalid"]
Ended = Literal["goal", "stop", "timeout", "failure"]


class TriggeredEvent(msgspec.Struct, frozen=True, kw_only=True):
    """What became of an event. triggered_at_s and trigger_distance_m are absent if its trigger
    never fired.

    seen: one of its people was before the robot once (`cosim.results.event_monitor`). rule_met:
    whether the robot kept the event's rule; absent where there is none."""

    id: str
    kind: str
    passed: bool
    triggered_at_s: float | None = None
    trigger_distance_m: float | None = None
    seen: bool = False
    rule_met: bool | None = None


class RedLightEntry(msgspec.Struct, frozen=True):
    """The robot entered a crossing of its route whose signal said stop."""

    tick: int
    crossing: str


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """What came out of one episode. reason: why it crashed or is invalid. clock: wall times, not
    reproducible.

    seed: of the scenario; run_seed: of the run, from which is drawn what the policy was told that
    it is called: episode. split, structure: of the scenario; crowd_added: its crowd is not the
    suite's own (`CrowdSpec.added`). policy_source: hash of the file that the policy is written in
    (`cosim.policies.load.source_hash`). policy_runs: where it ran. clock: also how long the answers
    of one that ran elsewhere took. walked_into: contacts with people who walked into the robot
    where it stood; no failures. waypoints: how those that it answers were followed. latency_ms: of
    its commands, as asked for; in real_time the median of those that were measured, and another one
    the next time: such a record is replayed, not made again. latency_ms is counted in whole ticks;
    what the policy took for an answer is `answer_ms`. metric_schema: METRIC_SCHEMA of the version
    that made the measures, 0 where that did not say. injections: pedestrians that came in from
    outside; with them the episode can be replayed. crashed: its policy crashed, which counts as a
    failure. invalid: what the simulator owes, counted apart: it came to its end without a failure,
    and its event had not happened or could not be seen; or an engine failed, twice. ended: absent
    if it did not come to its end: then there is no trajectory.

    `Record.load` reads the record.json of a run folder and raises RunError naming the file and the
    field.

    >>> Record.load(Path("runs/mine/episodes/lh-011-00/record.json"))
    Traceback (most recent call last):
    cosim.core.errors.RunError: runs/mine/episodes/lh-011-00/record.json: ...
    """

    scenario: str
    scenario_hash: str
    suite: str
    suite_hash: str
    seed: int
    split: Split = "val"
    structure: str = ""
    crowd_added: bool = False
    run_seed: int = 0
    episode: str = ""
    robot: str
    policy: str
    policy_version: str
    policy_source: str = ""
    policy_runs: PolicyRuns = "in-process"
    waypoints: WaypointRule = WaypointRule()
    camera: CameraSpec | None = None
    cameras: dict[str, CameraSpec] = {}
    rate_hz: float = 4.0
    nonstandard: str = ""
    goal_protocol: str
    odometry: OdometryKind = "none"
    privileged: bool = False
    latency_ms: float = 0.0
    real_time: bool = False
    renderer: str
    versions: dict[str, str]
    status: Status
    reason: str = ""
    ended: Ended | None = None
    ticks: int = 0
    state_hash: str = ""
    measures: dict[str, float | None] = {}
    failures: tuple[Failure, ...] = ()
    walked_into: tuple[Failure, ...] = ()
    red_light_entries: tuple[RedLightEntry, ...] = ()
    events: tuple[TriggeredEvent, ...] = ()
    injections: tuple[Injected, ...] = ()
    metric_schema: int = 0
    schema: int = _SCHEMA
    clock: dict[str, float] = {}

    @property
    def answer_ms(self) -> float | None:
        """In real time the median of what the policy took for an answer, as it was measured; else
        None."""
        return self.clock.get("answer_ms") if self.real_time else None

    def save(self, path: Path) -> None:
        """Write as JSON, whole or not at all."""
        write_atomic(path, self.encoded())

    def encoded(self) -> bytes:
        """The JSON that is the file."""
        return msgspec.json.format(msgspec.json.encode(self), indent=1) + b"\n"

    @classmethod
    def load(cls, path: Path) -> Record:
        """Read a record. Raises RunError naming the file and the field."""
        try:
            data = read_within(path, _MOST_BYTES)
        except OSError as error:
            raise RunError(f"{path}: not an episode record: {error.strerror}") from error
        except ValueError as error:
            raise RunError(f"{path}: not an episode record: {error}") from error
        return cls.decoded(data, path)

    @classmethod
    def decoded(cls, data: bytes, where: Path) -> Record:
        """The record in a file's bytes. where: what an error names. Raises RunError."""
        try:
            record = msgspec.json.decode(data, type=cls)
        except (msgspec.DecodeError, RecursionError, SpecError) as error:
            raise RunError(f"{where}: not an episode record: {error}") from error
        if record.schema != _SCHEMA:
            raise RunError(f"{where}: record schema {record.schema}; this version reads {_SCHEMA}")
        return record


def begun(
    scenario: Scenario,
    manifest: Manifest,
    suite_hash: str,
    policy_source: str = "",
    run_seed: int = 0,
    latency_ms: float = 0.0,
    real_time: bool = False,
    policy_runs: PolicyRuns = "in-process",
) -> Record:
    """The record of an episode about which nothing is known yet but what is run: crashed, until it
    is done."""
    return Record(
        scenario=scenario.id,
        scenario_hash=content_hash(scenario),
        suite=scenario.suite,
        suite_hash=suite_hash,
        seed=scenario.seed,
        split=scenario.split,
        structure=scenario.structure,
        crowd_added=scenario.crowd.added,
        run_seed=run_seed,
        episode=pseudonym_of(run_seed, scenario).episode,
        robot=scenario.robot,
        policy=manifest.name,
        policy_version=manifest.version,
        policy_source=policy_source,
        policy_runs=policy_runs,
        waypoints=manifest.waypoints,
        camera=manifest.camera,
        cameras=dict(manifest.cameras),
        rate_hz=manifest.rate_hz,
        nonstandard=nonstandard(manifest, robot_called(scenario.robot)),
        goal_protocol=manifest.goal,
        odometry=manifest.odometry,
        privileged=manifest.privileged,
        latency_ms=latency_ms,
        real_time=real_time,
        renderer=NO_RENDERER,
        versions=versions(),
        status="crashed",
        metric_schema=METRIC_SCHEMA,
    )


class StateHash:
    """A running hash of everything simulated: robot, people, vehicles, signals, contacts, at every
    tick."""

    def __init__(self) -> None:
        self._hash = hashlib.blake2b(digest_size=16)

    def add(self, step: Step) -> None:
        robot = step.motion.robot
        street = step.street_after
        for array in (
            np.array([*robot.pose, robot.v_mps, robot.w_radps, robot.z_m, robot.tilt_rad]),
            step.motion.trace,
            street.people.xy,
            street.people.heading,
            street.vehicles.xy,
            street.vehicles.heading,
        ):
            self._hash.update(np.ascontiguousarray(array, dtype="<f8").data)
        names = [*street.people.ids, *street.vehicles.ids, *(c.other for c in step.motion.contacts)]
        names += [f"{name}{signal.walk}" for name, signal in sorted(street.signals.items())]
        self._hash.update("|".join(names).encode())

    def hexdigest(self) -> str:
        return self._hash.hexdigest()


class Recorder:
    """Collects the Steps of an episode into a Log."""

    PEOPLE_EVERY_TICKS = 20
    PEOPLE_WITHIN_M = 30.0

    def __init__(self, tick_s: float, footprint_m: tuple[float, float]) -> None:
        self._tick_s = tick_s
        self._footprint_m = footprint_m
        self._values: dict[str, list[float | Sequence[float]]] = {name: [] for name in COLUMNS}
        self._people: list[tuple[float, ...]] = []
        self.hash = StateHash()

    def add(self, step: Step, verdict: Verdict, road: OnRoad = OnRoad()) -> None:  # noqa: B008  a frozen value
        self.hash.add(step)
        tick = Tick(step, verdict, self._footprint_m, road)
        for name, column in COLUMNS.items():
            self._values[name].append(column.read(tick))
        if step.tick % self.PEOPLE_EVERY_TICKS == 0:
            people = step.street_after.people
            xy = people.xy - step.motion.robot.pose.xy
            people = people.only(
                np.flatnonzero(np.hypot(xy[:, 0], xy[:, 1]) < self.PEOPLE_WITHIN_M)
            )
            for xy, kind, age in zip(
                people.xy.tolist(), people.kind.tolist(), people.age.tolist(), strict=True
            ):
                self._people.append((step.tick, *xy, kind, age))

    def log(self, event_tracks: Floats, commands: InFlight) -> Log:
        """The episode so far. event_tracks: see `Log`; commands: all that the policy answered."""
        people = np.array(self._people, dtype=float).reshape(-1, 5)
        plan_sizes, plan_points, plan_index = commands.plans
        return Log(
            tick_s=self._tick_s,
            **{name: column.array(self._values[name]) for name, column in COLUMNS.items()},
            people_tick=people[:, 0].astype(np.int64),
            people_xy=people[:, 1:3],
            people_kind=people[:, 3].astype(np.int8),
            people_age=people[:, 4].astype(np.int8),
            event_tracks=event_tracks,
            answers=commands.answers,
            plan_sizes=plan_sizes,
            plan_points=plan_points,
            plan_index=plan_index,
        )
