"""Collect a data set of an expert that drives scenarios, with the pictures of a camera.

OUT/collect.json      options of the collection; other options are refused
OUT/runs/00, 01 ..    run folders, with a demonstration of each accepted episode; one is added if
                      too few are solved. Of other formats than raw, they may be deleted once the
                      data set is complete
OUT/writing           unfinished data set
OUT/about.json        with the format raw: what `cosim dataset pack` needs besides the runs, in
                      place of the following
OUT/bags              with the format rosbag2 a ROS 2 bag of each episode, in place of the following
OUT/meta, data, videos   the data set; meta is written last and marks it as complete
"""

from __future__ import annotations

import json
import math
import shutil
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from bridge.ros2.types import message_store
from cosim.core.errors import RunError, SpecError, unwritable
from cosim.core.files import write_atomic
from cosim.core.progress import Progress, ignore
from cosim.core.versions import versions
from cosim.episode.policy_caller import PolicyCaller
from cosim.policies.user_module import importable_name
from cosim.results.record import Record
from cosim.results.run_folder import DEMONSTRATION, RunFolder
from cosim.results.run_spec import brief
from cosim.spec.demo_options import DemoOptions
from cosim.spec.options import EpisodeOptions, PolicyHost
from cosim.spec.run_config import DataFormat
from cosim.spec.scenario import City, Scenario, Suite, read_suite
from scenarios.episodes.demonstration import Demonstration, check_parquet
from scenarios.episodes.demonstrator import Demonstrator, load_learner
from scenarios.ipc.messages import Hello, MessageHandler
from scenarios.runs.local import LocalProcesses
from scenarios.runs.planning import run_spec
from scenarios.runs.policy_host import settled_host
from scenarios.runs.pool import run_all
from scenarios.suites.catalog import with_robot, with_weather
from scenarios.suites.fits import check_places
from scenarios.suites.new_scenarios import NewScenarios
from scenarios.tools.dataset.collected import ABOUT, RUNS, Collected
from scenarios.tools.dataset.variety import varied
from scenarios.tools.viewing.bag import write_bag

if TYPE_CHECKING:
    from scenarios.tools.dataset.read import ReadBack

_SPEC_FILE: Final = "collect.json"
_WRITING: Final = "writing"
_PARTS: Final = ("videos", "data", "meta")
_MAX_ROUNDS: Final = 8
_BLOCK: Final = 1000
"""Most episodes of a round of the format raw; drawing a round cannot be interrupted."""
_STAGE: Final = "writing the data set"


class CollectSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Options of a collection: equal options give equal data sets.

    scenarios: ids of a suite, in order, or new scenarios.
    episodes: number of episodes in the data set.
    """

    suite: str
    suite_hash: str = ""
    scenarios: tuple[str, ...] = ()
    new_scenarios: NewScenarios | None = msgspec.field(default=None, name="fresh")
    episodes: int
    policy: str
    policy_source: str
    robot: str = ""
    weather: str = ""
    goal: str
    seed: int
    collecting: DemoOptions
    learner_source: str = ""
    renderer: str
    versions: dict[str, str]

    def refuse_other(self, requested: CollectSpec, path: Path) -> None:
        """Raise RunError, with the first difference, if the requested options differ."""
        for name in self.__struct_fields__:
            mine, theirs = getattr(self, name), getattr(requested, name)
            if isinstance(mine, msgspec.Struct) and isinstance(theirs, msgspec.Struct):
                for part in mine.__struct_fields__:
                    _refuse(path, part, getattr(mine, part), getattr(theirs, part, None))
            _refuse(path, name, mine, theirs)


def _refuse(path: Path, name: str, mine: object, theirs: object) -> None:
    if mine != theirs:
        raise RunError(
            f"{path} is of another data set: its {name} is {brief(mine)}, and this command has "
            f"{brief(theirs)}. Continue with the same command, or choose another --out."
        )


@dataclass(frozen=True)
class CollectResult:
    """Result of a collection.

    stored, rows: number of episodes and rows of the data set.
    run: number of driven episodes.
    dropped: numbers of excluded episodes by reason.
    spare: number of solved episodes beyond the requested number.
    back: result of reading the data set back; None if it was complete before or has no tables.
    form: format of the data set.
    whole: true if it is complete, false if the time was up.
    """

    stored: int
    rows: int
    run: int
    dropped: Counter[str]
    spare: int
    back: ReadBack | None
    form: DataFormat = "lerobot"
    whole: bool = True


_Showing = Callable[[Sequence[Scenario], set[str]], AbstractContextManager[MessageHandler]]
"""Display of a run. Arguments: its scenarios, and the names of those that are done."""


def _unshown(
    scenarios: Sequence[Scenario], done: set[str]
) -> AbstractContextManager[MessageHandler]:
    return nullcontext(ignore)


def collect(
    source: Suite | NewScenarios,
    expert: PolicyCaller,
    policy: str,
    out: Path,
    *,
    collecting: DemoOptions,
    options: EpisodeOptions,
    episodes: int | None = None,
    jobs: int = 1,
    host: PolicyHost = PolicyHost(),  # noqa: B008  a frozen value
    resume: bool = False,
    minutes: float = math.inf,
    showing: _Showing = _unshown,
    progress: Progress = ignore,
) -> CollectResult:
    """Collect demonstrations into a folder.

    The same arguments give the same bytes, for any `jobs` and any number of calls with `resume`.

    source: scenarios, in order.
    expert: policy that drives the robot.
    policy: name of the expert.
    options: seed, robot, weather, goal, own_camera and camera are used.
    episodes: number of episodes in the data set; by default all that are solved.
    host: where the expert is queried.
    minutes: time after which no further episode begins; `resume` continues.
    showing, progress: display of the run.

    Raises RunError for a folder of another data set. Raises UsageError and SpecError for invalid
    arguments, and MachineError if the machine lacks a requirement.
    """
    ends_s = time.monotonic() + 60.0 * minutes
    form = collecting.format
    _check_packages(form)
    policy = importable_name(policy)
    collecting = msgspec.structs.replace(collecting, learner=importable_name(collecting.learner))
    options = msgspec.structs.replace(options, collecting=collecting, seed=options.seed or 0)
    demonstrator = Demonstrator(expert, collecting, options.goal, load_learner(collecting))
    wanted = episodes or (
        len(source.structures) * len(source.seeds) if isinstance(source, NewScenarios) else None
    )
    rounds = _Rounds(source, out.absolute(), policy, demonstrator, options, jobs, ends_s, progress)
    spec = rounds.requested(wanted or len(rounds.all), expert)
    _open(out, spec, resume)
    if form == "raw":
        _write_about(out, _about(spec, demonstrator, rounds.robot))
    host = settled_host(host, expert)
    hello = _hello(policy, expert, host, collecting.learner, demonstrator)
    with ExitStack() as stack:
        driven = _drive_rounds(stack, rounds, spec, hello, showing)
        found = driven.episodes
        whole = len(found) >= spec.episodes or not rounds.over()
        if not found and whole:
            raise SpecError(f"{out}: {driven.why_none}")
        stored = found[: spec.episodes]
        back = None
        if whole and form == "rosbag2":
            folders = {one.scenario.id: driven.folders[one.scenario.id] for one in stored}
            _write_bags(out, folders, progress)
        elif whole and form == "lerobot" and not (out / "meta").exists():
            back = _written(out, stored, spec, demonstrator, progress)
    rows = sum(len(one.load()) for one in stored) if whole and form != "raw" else 0
    spare = len(found) - len(stored)
    return CollectResult(len(stored), rows, driven.run, driven.dropped, spare, back, form, whole)


def _check_packages(form: DataFormat) -> None:
    """Raise MachineError if a package that writes the format is missing."""
    if form == "rosbag2":
        message_store()
    if form != "raw":
        check_parquet()


def _hello(
    policy: str,
    expert: PolicyCaller,
    host: PolicyHost,
    learner_name: str,
    demonstrator: Demonstrator,
) -> Hello:
    """Return the message that names expert and learner to environment processes."""
    learner = None
    if (caller := demonstrator.learner) is not None:
        learner = Hello(learner_name, caller.manifest, caller.source_hash)
    return Hello(policy, expert.manifest, expert.source_hash, host=host, learner=learner)


@dataclass
class _Driven:
    """Result of all rounds.

    episodes: accepted ones, in order.
    folders: run folder of each scenario.
    dropped: numbers of excluded episodes by reason.
    run: number of driven episodes.
    """

    episodes: list[Collected]
    folders: dict[str, Path]
    dropped: Counter[str]
    run: int = 0

    @property
    def why_none(self) -> str:
        """Error message where no episode was accepted."""
        reasons = (
            "; ".join(f"{words} ({count})" for words, count in self.dropped.most_common())
            or "none were drawn"
        )
        return f"none of {self.run} episodes can be stored: {reasons}"


def _drive_rounds(
    stack: ExitStack, rounds: _Rounds, spec: CollectSpec, hello: Hello, showing: _Showing
) -> _Driven:
    """Drive rounds until enough episodes are accepted, the time is up or scenarios run out.

    stack: closes the run folders.
    """
    driven = _Driven([], {}, Counter[str]())
    is_raw = spec.collecting.format == "raw"
    taken = 0
    number = 0
    limit = _MAX_ROUNDS * (-(-spec.episodes // _BLOCK) if is_raw else 1)
    while len(driven.episodes) < spec.episodes and number < limit and not rounds.over():
        lacking = spec.episodes - len(driven.episodes)
        count = lacking + (lacking // 2 + 1 if number else 0)
        count = min(count, _BLOCK) if is_raw else count
        held, scenarios = rounds.opened(stack, number, taken, count)
        if held is None:
            break
        rounds.run(held, scenarios, hello, showing)
        driven.episodes += _demonstrated(held, scenarios, driven.dropped)
        driven.folders |= dict.fromkeys((one.id for one in scenarios), held.path)
        driven.run += len(scenarios)
        taken += count
        number += 1
    return driven


@dataclass(frozen=True)
class _Rounds:
    """Runs that form a data set."""

    source: Suite | NewScenarios
    out: Path
    policy: str
    demonstrator: Demonstrator
    options: EpisodeOptions
    jobs: int
    ends_s: float
    progress: Progress

    def over(self) -> bool:
        """Return whether the time is up."""
        return time.monotonic() > self.ends_s

    @property
    def all(self) -> tuple[Scenario, ...]:
        """The scenarios of a suite."""
        return () if isinstance(self.source, NewScenarios) else self.source.scenarios

    @property
    def robot(self) -> str:
        """The robot of the scenarios, in suites with several that of the first one."""
        return self._whole.scenarios[0].robot

    @property
    def _whole(self) -> Suite:
        """The scenarios of a suite with the requested robot, or a placeholder for new ones."""
        some = self.all or _nowhere(self.source)
        return with_robot(
            Suite(name="requested", version="1", scenarios=tuple(some)), self.options.robot
        )

    def requested(self, episodes: int, expert: PolicyCaller) -> CollectSpec:
        """Return the requested options, checked as far as possible without a place. Raises
        UsageError.
        """
        whole = self._whole
        run = run_spec(whole, whole.scenarios, self.policy, self.demonstrator, self.options)
        is_new = isinstance(self.source, NewScenarios)
        return CollectSpec(
            suite=self.source.kind if isinstance(self.source, NewScenarios) else self.source.name,
            suite_hash="" if isinstance(self.source, NewScenarios) else self.source.content_hash,
            scenarios=() if is_new else tuple(one.id for one in self.all),
            new_scenarios=self.source if isinstance(self.source, NewScenarios) else None,
            episodes=episodes if is_new else min(episodes, len(self.all)),
            policy=self.policy,
            policy_source=expert.source_hash,
            robot=self.options.robot,
            weather=self.options.weather,
            goal=self.demonstrator.manifest.goal,
            seed=self.options.seed or 0,
            collecting=self.options.collecting or DemoOptions(),
            learner_source=""
            if (learner := self.demonstrator.learner) is None
            else learner.source_hash,
            renderer=run.setup.renderer,
            versions=versions(),
        )

    def opened(
        self, stack: ExitStack, number: int, taken: int, count: int
    ) -> tuple[RunFolder | None, Sequence[Scenario]]:
        """Return the run folder of a round and its scenarios. Scenarios of an existing folder are
        read.
        """
        path = self.out / RUNS / f"{number:02d}"
        if begun := (path / "run.json").exists():
            suite = read_suite(path / "scenarios.json")
        else:
            suite = self._suite(taken, count)
        if not suite.scenarios:
            return None, ()
        spec = run_spec(suite, suite.scenarios, self.policy, self.demonstrator, self.options)
        if not begun and not isinstance(self.source, NewScenarios):
            check_places(suite, suite.scenarios, self.progress, self.jobs)
        held = RunFolder.resume(path, spec) if begun else RunFolder.create(path, spec, suite)
        return stack.enter_context(held), suite.scenarios

    def _suite(self, taken: int, count: int) -> Suite:
        if isinstance(self.source, NewScenarios):
            drawn = self.source.drawn(taken, count, self.jobs, self.progress)
            version = f"cities-{self.source.seeds[0]}-{self.source.seeds[-1]}"
            made = Suite(name=self.source.kind, version=version, scenarios=tuple(drawn))
        else:
            chosen = self.all[taken : taken + count]
            made = msgspec.structs.replace(self.source, scenarios=chosen)
        made = with_weather(with_robot(made, self.options.robot), self.options.weather)
        collecting, seed = self.options.collecting or DemoOptions(), self.options.seed or 0
        return msgspec.structs.replace(made, scenarios=varied(made.scenarios, collecting, seed))

    def run(
        self, held: RunFolder, scenarios: Sequence[Scenario], hello: Hello, showing: _Showing
    ) -> None:
        """Drive the missing episodes."""
        done = held.finished_ids()
        todo = [one for one in scenarios if one.id not in done]
        if todo:
            with showing(scenarios, done) as handle:
                transport = LocalProcesses(held.path / "logs", self.jobs)
                run_all(
                    held,
                    todo,
                    hello,
                    transport,
                    handle=handle,
                    options=self.options,
                    over=self.over,
                )
        held.finish()


def _nowhere(source: Suite | NewScenarios) -> list[Scenario]:
    """Return a placeholder for new scenarios before any is drawn, for checks of robot and
    camera.
    """
    name = source.kind if isinstance(source, NewScenarios) else source.name
    route = ((0.0, 0.0), (12.0, 0.0))
    return [
        Scenario(
            id="a",
            suite=name,
            place=City(seed=0),
            seed=0,
            start=(0.0, 0.0, 0.0),
            goal=route[1],
            route=route,
        )
    ]


def _open(out: Path, spec: CollectSpec, resume: bool) -> None:
    """Create a folder, or resume it. Raises RunError for one of another data set."""
    path = out / _SPEC_FILE
    try:
        if path.exists():
            try:
                found = msgspec.json.decode(path.read_bytes(), type=CollectSpec)
            except msgspec.DecodeError as error:
                raise RunError(f"{path}: cannot be read: {error}: choose another --out") from error
            found.refuse_other(spec, out)
            if not resume:
                raise RunError(
                    f"{out} already holds a data set, or a part of one. Add --resume to "
                    f"continue it."
                )
            return
        if out.exists() and (
            not out.is_dir() or any(one.name != f"{_SPEC_FILE}.part" for one in out.iterdir())
        ):
            raise RunError(f"{out} exists and is no data set. Choose another --out.")
        (out / RUNS).mkdir(parents=True, exist_ok=True)
        write_atomic(path, msgspec.json.format(msgspec.json.encode(spec), indent=1) + b"\n")
    except OSError as error:
        raise unwritable(out, error) from error


def _demonstrated(
    held: RunFolder, scenarios: Sequence[Scenario], dropped: Counter[str]
) -> list[Collected]:
    """Return the episodes of a run with a demonstration, in the order of its scenarios."""
    found = []
    done = held.finished_ids()
    for scenario in scenarios:
        if scenario.id not in done:
            continue  # the time was up
        folder = held.episode_folder(scenario.id)
        record = Record.load(folder / "record.json")
        path = folder / DEMONSTRATION
        if path.exists():
            found.append(Collected(scenario, record, partial(_loaded, path)))
        else:
            dropped[_why(record)] += 1
    return found


def _loaded(path: Path) -> Demonstration:
    try:
        return Demonstration.decoded(path.read_bytes(), path)
    except OSError as error:
        raise RunError(
            f"{path}: cannot be read: {error.strerror}: collect it again, in another --out"
        ) from error


def _why(record: Record) -> str:
    """Return a short reason for excluding an episode."""
    if record.status != "done":
        return record.status
    if record.failures:
        first = record.failures[0]
        return " with ".join(filter(None, (first.kind, first.other_kind))).replace("_", " ")
    return f"ended by {record.ended}"


def _write_bags(out: Path, runs: Mapping[str, Path], progress: Progress) -> None:
    """Write the bag of each episode that has none. runs: run folder by scenario."""
    for number, (name, folder) in enumerate(runs.items()):
        progress("writing bags", number / len(runs))
        if not (bag := out / "bags" / name).exists():
            bag.parent.mkdir(exist_ok=True)
            write_bag(folder, name, bag)


def _written(
    out: Path,
    stored: Sequence[Collected],
    spec: CollectSpec,
    demonstrator: Demonstrator,
    progress: Progress,
) -> ReadBack:
    """Write the data set, read it back, and only then move it to its place."""
    from scenarios.tools.dataset.lerobot import Filmed, write_lerobot
    from scenarios.tools.dataset.read import read_back

    progress(_STAGE)
    camera = spec.collecting.camera
    robot = stored[0].scenario.robot
    eye = camera.mount if isinstance(camera.mount, str) else "camera"
    filmed = Filmed(eye, camera.size, round(spec.collecting.rate_hz))
    about = _about(spec, demonstrator, robot)
    writing = out / _WRITING
    try:
        for name in (_WRITING, *_PARTS):
            shutil.rmtree(out / name, ignore_errors=True)
        writing.mkdir()
        write_lerobot(writing, stored, filmed, robot, about)
        back = read_back(writing, stored, progress)
        for name in _PARTS:
            (writing / name).rename(out / name)
        writing.rmdir()
    except OSError as error:
        raise unwritable(
            out, error, "episodes are stored; make room and continue with --resume"
        ) from error
    return back


def _write_about(out: Path, about: dict[str, Any]) -> None:
    """Write what packing needs besides the runs. Raises MachineError."""
    try:
        write_atomic(out / ABOUT, json.dumps(about, indent=1).encode() + b"\n")
    except OSError as error:
        raise unwritable(out, error) from error


def _about(spec: CollectSpec, demonstrator: Demonstrator, robot: str) -> dict[str, Any]:
    """Return how the data set was collected."""
    camera = spec.collecting.camera
    learner = "" if demonstrator.learner is None else demonstrator.learner.manifest.name
    explores = spec.collecting.explore > 0.0
    return {
        "rate_hz": spec.collecting.rate_hz,
        "waypoint_s": spec.collecting.waypoint_s,
        "waypoints": spec.collecting.waypoints,
        "goal": spec.goal,
        "camera": msgspec.to_builtins(camera),
        "lidar": msgspec.to_builtins(demonstrator.manifest.scan),
        "imu": demonstrator.manifest.imu,
        "people": demonstrator.manifest.people,
        "robot": robot,
        "weather": spec.weather,
        "policy": "" if explores else demonstrator.manifest.name,
        "policy_source": spec.policy_source,
        "noise": spec.collecting.noise,
        "learner": "" if explores else learner,
        "explorer": learner if explores else "",
        "explore": spec.collecting.explore,
        "learner_source": spec.learner_source,
        "suite": spec.suite,
        "seed": spec.seed,
        "renderer": spec.renderer,
        "versions": spec.versions,
    }
