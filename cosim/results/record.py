"""Record of an episode: `record.json`, and the recorder for `trajectory.npz`.

All of a record except `clock` is a function of scenario, policy and versions: two runs give the
same bytes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from cosim.core.errors import RunError, SpecError
from cosim.core.files import read_limited, write_atomic
from cosim.core.geometry import Floats
from cosim.core.state import Motion
from cosim.episode.command_delay import CommandDelay
from cosim.episode.loop import Step
from cosim.episode.manifest_checks import fault_of_values, nonstandard
from cosim.results.flat_file import FlatFile
from cosim.results.log import COLUMNS, Log, Tick
from cosim.results.referee import Ended, Failure, Verdict
from cosim.results.run_setup import RunSetup
from cosim.results.traffic import RoadState
from cosim.results.walked import walked_m
from cosim.spec.episode_id import episode_id_of
from cosim.spec.injection import Injected
from cosim.spec.manifest import Manifest
from cosim.spec.robot import robot_called
from cosim.spec.run_config import Appearance
from cosim.spec.scenario import Scenario, Split, content_hash
from cosim.spec.weather import CLEAR

_SCHEMA = 1
_MAX_BYTES = 256 << 20

Status = Literal["done", "crashed", "invalid"]


class TriggeredEvent(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of an event.

    triggered_at_s, trigger_distance_m: None if the trigger never fired
    seen: whether the standard camera saw one of its people (`cosim.results.event_monitor`)
    staged: False if the simulator owes the event: it cannot begin before the goal, or it began and
        none of its people was ever near the robot
    rule_met: whether the robot obeyed the event's rules; None without a rule
    passed_at_s: end of the window of the go-on rule (`cosim.results.go_on`), which begins at the
        trigger; None if the robot did not pass, or in other events than decoys
    passing_mps, stopped_s: mean speed along the route and longest stop in this window
    """

    id: str
    kind: str
    passed: bool
    triggered_at_s: float | None = None
    trigger_distance_m: float | None = None
    seen: bool = False
    staged: bool = True
    rule_met: bool | None = None
    passed_at_s: float | None = None
    passing_mps: float | None = None
    stopped_s: float | None = None


class RedLightEntry(msgspec.Struct, frozen=True):
    """Entry of a crossing of the route at red."""

    tick: int
    crossing: str


class ScenarioFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Identity of an episode's scenario.

    hash: content hash of the whole spec
    decoy_of: id of the scenario whose decoy it is, "" for any other
    crowd_added: whether the crowd is not the suite's own (`CrowdSpec.added`)
    weather: name of its weather
    """

    id: str
    hash: str
    suite: str
    seed: int
    split: Split = "val"
    structure: str = ""
    decoy_of: str = ""
    crowd_added: bool = False
    weather: str = CLEAR
    robot: str

    @classmethod
    def of(cls, scenario: Scenario) -> ScenarioFacts:
        """Extract the facts of a scenario."""
        return cls(
            id=scenario.id,
            hash=content_hash(scenario),
            suite=scenario.suite,
            seed=scenario.seed,
            split=scenario.split,
            structure=scenario.structure,
            decoy_of=scenario.decoy_of,
            crowd_added=scenario.crowd.added,
            weather=scenario.conditions.name,
            robot=scenario.robot,
        )


class ScanLook(msgspec.Struct, frozen=True, kw_only=True):
    """Look of a scanned place in the pictures of a policy.

    splats: content hash of the splats that were drawn, "" for the mesh's look
    sun_azimuth_deg, sun_elevation_deg: direction to its sun, clockwise from north and above the
        horizon; None if it is unknown
    """

    appearance: Appearance
    splats: str = ""
    sun_azimuth_deg: float | None = None
    sun_elevation_deg: float | None = None

    @property
    def in_words(self) -> str:
        """Description for notes."""
        look = f"splats {self.splats}" if self.splats else "the mesh"
        if self.sun_azimuth_deg is None:
            return f"{look} without sun"
        return f"{look} with the sun at {self.sun_azimuth_deg:g}, {self.sun_elevation_deg:g}"


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one episode: scenario, run set-up, manifest and outcome.

    In record.json and results.csv all of it is flat; a new field appears in both.

    manifest: includes the goals of the run, except `goals`, which are not recorded
    episode: id of the episode sent to the policy, drawn from the run's seed
    nonstandard: what no camera mount of the robot allows, in words
    scan: how a scanned place looked to the policy's cameras; None without cameras or scan
    status: "crashed": the policy crashed, which counts as a failure. "invalid": the simulator is at
        fault: no failure, but the event could not begin or nobody came; or an engine failed twice
    reason: why the episode crashed or is invalid, or how the robot bypassed its event
        (`cosim.results.validity`)
    ended: None if the episode did not end; then there is neither trajectory nor measure, and ticks,
        state hash, failures and events are those before the crash
    walked_into: contacts with people who walked into the resting robot, and the falls that
        followed (`Failure.kind`); not failures
    injections: pedestrians injected from outside; needed for a replay
    clock: wall times, not reproducible, and answer times of a policy in another process

    `Record.load` reads the record.json of a run folder and raises RunError naming the file and the
    field.

    >>> Record.load(Path("runs/mine/episodes/lh-011-00/record.json"))
    Traceback (most recent call last):
    cosim.core.errors.RunError: runs/mine/episodes/lh-011-00/record.json: ...
    """

    scenario: ScenarioFacts
    setup: RunSetup
    manifest: Manifest
    episode: str = ""
    nonstandard: str = ""
    scan: ScanLook | None = None
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
    schema: int = _SCHEMA
    clock: dict[str, float] = {}

    @classmethod
    def begun(cls, scenario: Scenario, manifest: Manifest, setup: RunSetup) -> Record:
        """Create the record of an episode that starts; its status is "crashed" until it is done."""
        return cls(
            scenario=ScenarioFacts.of(scenario),
            setup=setup,
            manifest=replace(manifest, cameras=dict(manifest.cameras), goals=()),
            episode=episode_id_of(setup.seed, scenario).episode,
            nonstandard=nonstandard(manifest, robot_called(scenario.robot)),
            status="crashed",
        )

    @property
    def answer_ms(self) -> float | None:
        """Median measured answer time of the policy in real time; else None."""
        return self.clock.get("answer_ms") if self.setup.real_time else None

    def save(self, path: Path) -> None:
        """Write the record as JSON, atomically."""
        write_atomic(path, self.encoded())

    def encoded(self) -> bytes:
        """Return the bytes of the JSON file."""
        return RECORD_FILE.encode_indented(self)

    @classmethod
    def load(cls, path: Path) -> Record:
        """Load a record. Raises RunError naming the file and the field."""
        try:
            data = read_limited(path, _MAX_BYTES)
        except OSError as error:
            raise RunError(f"{path}: not an episode record: {error.strerror}") from error
        except ValueError as error:
            raise RunError(f"{path}: not an episode record: {error}") from error
        return cls.decoded(data, path)

    @classmethod
    def decoded(cls, data: bytes, where: Path) -> Record:
        """Decode a record.

        where: path named in errors.

        Raises RunError.
        """
        try:
            record = RECORD_FILE.decode(data)
        except (msgspec.DecodeError, RecursionError, SpecError) as error:
            raise RunError(f"{where}: not an episode record: {error}") from error
        if record.schema != _SCHEMA:
            raise RunError(f"{where}: record schema {record.schema}; this version reads {_SCHEMA}")
        return record


RECORD_FILE = FlatFile(
    Record,
    {"scenario": ScenarioFacts, "setup": RunSetup, "manifest": Manifest},
    """
    scenario=scenario.id scenario_hash=scenario.hash suite suite_hash seed=scenario.seed
    split structure decoy_of crowd_added weather run_seed=setup.seed episode robot
    policy=manifest.name policy_version=manifest.version policy_source policy_runs waypoints
    camera cameras rate_hz nonstandard goal_protocol=manifest.goal odometry lidar=manifest.scan
    imu=manifest.imu people=manifest.people privileged latency_ms real_time renderer
    gait gait_hash versions status reason ended ticks state_hash measures failures walked_into
    red_light_entries events injections metric_schema schema clock
    scan=scan
    """,
    without="manifest.goals",
    defaults={"camera": None},
    fault=lambda record: fault_of_values(record.manifest),
)
"""Layout of record.json: flat, for compatibility with files written before `Record` had parts."""


def _legs_of(motion: Motion) -> tuple[float, ...]:
    """Return what the state hash holds of a robot with legs; nothing on wheels."""
    legs = motion.robot.legs
    if legs is None:
        return ()
    return (*legs.angles_rad, legs.roll_rad, legs.pitch_rad, float(motion.down))


class StateHash:
    """Running hash of the simulated state: robot, people, vehicles, signals and contacts at each
    tick. With legs the robot's part includes joint angles, roll, pitch and `Motion.down`."""

    def __init__(self) -> None:
        self._hash = hashlib.blake2b(digest_size=16)

    def add(self, step: Step) -> None:
        """Add the state at the end of a step."""
        robot = step.motion.robot
        street = step.street_after
        for array in (
            np.array([*robot.pose, robot.v_mps, robot.w_radps, robot.z_m, robot.tilt_rad]),
            np.array(_legs_of(step.motion)),
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
    """Collects the steps of an episode into a Log.

    columns: columns that are recorded; the arrays of all others are empty.
    cycle_s: duration of a gait cycle, 0 on wheels. With legs poses are always recorded.
    """

    PEOPLE_EVERY_TICKS = 20
    PEOPLE_WITHIN_M = 30.0

    def __init__(
        self,
        tick_s: float,
        footprint_m: tuple[float, float],
        columns: Iterable[str] = tuple(COLUMNS),
        cycle_s: float = 0.0,
    ) -> None:
        self._tick_s = tick_s
        self._cycle_s = cycle_s
        names = dict.fromkeys([*columns, *(("pose", "reset_s_m") if cycle_s else ())])
        self._footprint_m = footprint_m
        self._values: dict[str, list[float | Sequence[float]]] = {name: [] for name in names}
        self._people: list[tuple[float, ...]] = []
        self.hash = StateHash()
        self.ticks = 0

    def add(self, step: Step, verdict: Verdict, road: RoadState = RoadState()) -> None:  # noqa: B008  a frozen value
        """Record one tick; people only every PEOPLE_EVERY_TICKS within PEOPLE_WITHIN_M."""
        self.hash.add(step)
        self.ticks += 1
        tick = Tick(step, verdict, self._footprint_m, road)
        for name, values in self._values.items():
            values.append(COLUMNS[name].read(tick))
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

    def log(self, event_tracks: Floats, commands: CommandDelay) -> Log:
        """Build the log of the ticks so far.

        event_tracks: see `Log`
        commands: all answers of the policy
        """
        people = np.array(self._people, dtype=float).reshape(-1, 5)
        plan_sizes, plan_points, plan_index = commands.plans
        columns = {
            name: column.array(self._values.get(name, ())) for name, column in COLUMNS.items()
        }
        if self._cycle_s:
            columns["travelled_m"] = walked_m(
                columns["pose"][:, :2], columns["reset_s_m"], self._cycle_s / self._tick_s
            )
        return Log(
            tick_s=self._tick_s,
            **columns,
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
