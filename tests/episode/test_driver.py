"""The driver that calls a policy safely: its inputs, its answers, its exceptions."""

from __future__ import annotations

import dataclasses
import os
import signal
from collections.abc import Callable, Sequence
from typing import NoReturn

import numpy as np
import pytest
from shapely.geometry import box

from cosim.core.errors import PolicyError
from cosim.core.geometry import Polyline, Pose
from cosim.core.state import STILL, Command, People, RobotState, Signal, Vehicles
from cosim.episode.interfaces import Observation, Privileged
from cosim.episode.policy_caller import PolicyCall, PolicyCaller
from cosim.spec.camera import Calibration, CameraPicture, CameraSpec
from cosim.spec.goal import ImageGoal, RoutePatch
from cosim.spec.manifest import Manifest, WaypointRule
from cosim.spec.robot import COURIER
from tests.conftest import without_lines

MINE = Manifest("mine", camera=None)


class FakePolicy:
    """A policy that acts as the test says."""

    def __init__(self, act: Callable[[Observation], object], manifest: Manifest = MINE) -> None:
        self.manifest = manifest
        self.does = act

    def reset(self, episode_id: str, seed: int) -> None:
        if episode_id == "bad":
            raise SystemExit(3)

    def act(self, observation: Observation) -> Command:
        return self.does(observation)  # type: ignore[return-value]


def observation_at(tick: int = 0, known: Privileged | None = None) -> Observation:
    return Observation(tick, 0.05 * tick, np.full((4, 4, 3), 7, np.uint8), 0.5, 0.0, COURIER, known)


def knowledge() -> Privileged:
    people = People.of(("c1",), [[1.0, 2.0]], [0.0], [1.0], ("walk",))
    vehicles = Vehicles.of(("v1",), [[5.0, 5.0]], [0.0], [8.0], [[4.0, 2.0]])
    robot = RobotState(Pose(0.0, 0.0, 0.0), 1.0)
    route = Polyline([(0, 0), (9, 0)])
    return Privileged(
        robot,
        route,
        0.0,
        people,
        vehicles,
        {"x": Signal(False, 3.0)},
        (("x", 1.0, 2.0),),
        box(0, 0, 9, 9),
    )


def raising(error: BaseException) -> Callable[[Observation], NoReturn]:
    def act(_: Observation) -> NoReturn:
        raise error

    return act


class UnreadableError(Exception):
    """An error whose message cannot be read."""

    def __str__(self) -> str:
        raise RuntimeError


@pytest.fixture
def ctrl_c_ignored() -> object:
    """Ctrl-C is ignored, as in an environment process."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (KeyError("no such weight"), "raised KeyError: 'no such weight' (act at 0.10 s)"),
        (SystemExit(3), "raised SystemExit: 3 (act at 0.10 s)"),
        (KeyboardInterrupt(), "raised KeyboardInterrupt (act at 0.10 s)"),
        (GeneratorExit(), "raised GeneratorExit (act at 0.10 s)"),
        (MemoryError(), "raised MemoryError (act at 0.10 s)"),
        (UnreadableError(), "raised UnreadableError: (its message cannot be read)"),
        (ValueError("\ud800\x1b[2J"), "raised ValueError: ??[2J"),
        (ValueError("x" * 10_000), "... (10000 characters)"),
    ],
    ids=["error", "exit", "ctrl-c", "generator", "memory", "mute", "odd-text", "long-text"],
)
def test_any_exception_of_a_policy_is_its_crash(
    ctrl_c_ignored: None, error: BaseException, expected: str
) -> None:
    """Also BaseExceptions and unprintable errors give one message with the policy's name and the
    time."""
    with pytest.raises(PolicyError) as caught:
        PolicyCaller(FakePolicy(raising(error))).act(observation_at(tick=2))
    assert str(caught.value).startswith("policy 'mine' raised ") and expected in without_lines(
        str(caught.value)
    )
    str(caught.value).encode()


def test_a_crash_names_the_last_line_of_the_users_code() -> None:
    """The message has file and line of the policy, also where numpy or a class of this project
    raised."""

    def by_numpy(_: Observation) -> Command:
        return Command(float(np.zeros(3).reshape(2)[0]), 0.0)

    line = by_numpy.__code__.co_firstlineno + 1
    with pytest.raises(
        PolicyError, match=rf"size 3 into shape \(2,\) in test_driver\.py:{line} \(act at 0\.00 s\)"
    ):
        PolicyCaller(FakePolicy(by_numpy)).act(observation_at(tick=0))


def test_a_reset_that_raises_is_a_crash_too() -> None:
    """An exception in reset is a crash whose message names reset."""
    with pytest.raises(
        PolicyError, match=r"policy 'mine' raised SystemExit: 3 in test_driver\.py:\d+ \(reset\)"
    ):
        PolicyCaller(FakePolicy(lambda _: STILL)).reset("bad", 0)


def test_ctrl_c_is_no_crash() -> None:
    """Ctrl-C in an interactive process ends the call as KeyboardInterrupt."""
    with pytest.raises(KeyboardInterrupt):
        PolicyCaller(FakePolicy(raising(KeyboardInterrupt()))).act(observation_at())


def test_an_answer_is_read_once_and_safely() -> None:
    """Numbers that raise when read, or change each time, cannot exceed the robot's limits."""

    class Pretends(float):
        def __float__(self) -> float:
            raise SystemExit(9)

    class Shifty(Command):
        @property
        def v_mps(self) -> float:  # type: ignore[override]
            return next(values)

    with pytest.raises(PolicyError, match="raised SystemExit: 9"):
        PolicyCaller(FakePolicy(lambda _: Command(Pretends(1.0), 0.0))).act(observation_at())
    values = iter([1.0, float("nan"), 99.0])
    shifty = object.__new__(Shifty)
    object.__setattr__(shifty, "w_radps", 0.0)
    assert PolicyCaller(FakePolicy(lambda _: shifty)).act(observation_at()) == Command(1.0, 0.0)


def test_a_policy_gets_copies_that_it_may_write_to() -> None:
    """Pictures, arrays, states and signals that it gets are copies."""

    def scribbles(observation: Observation) -> Command:
        observation.rgb[:] = 0  # type: ignore[index]
        known = observation.privileged
        assert known is not None
        people, vehicles = known.people, known.vehicles
        for array in (
            people.xy,
            people.heading,
            people.speed,
            people.strides,
            people.pace,
            known.route.points,
            known.route.s_m,
            vehicles.xy,
            vehicles.heading,
            vehicles.speed,
            vehicles.size,
        ):
            array.setflags(write=True)
            array[:] = 99.0
        object.__setattr__(known.robot, "v_mps", 99.0)
        object.__setattr__(known.signals["x"], "walk", True)
        known.signals["y"] = Signal(True)  # type: ignore[index]
        return STILL

    known = knowledge()
    observation = observation_at(known=known)
    PolicyCaller(FakePolicy(scribbles, dataclasses.replace(MINE, privileged=True))).act(observation)
    assert (observation.rgb == 7).all()
    again = knowledge()
    for kind in ("people", "vehicles"):
        mine, fresh = getattr(known, kind), getattr(again, kind)
        for field in dataclasses.fields(mine):
            assert np.array_equal(getattr(mine, field.name), getattr(fresh, field.name)), field.name
    assert known.robot == again.robot and dict(known.signals) == dict(again.signals)
    assert np.array_equal(known.route.points, again.route.points) and known.route.length_m == 9.0


def test_a_route_stays_the_same_object_through_an_episode() -> None:
    """The route is one object, so that a policy may prepare it once."""
    routes: list[object] = []

    def notes(observation: Observation) -> Command:
        assert observation.privileged is not None
        routes.append(observation.privileged.route)
        return STILL

    driver = PolicyCaller(FakePolicy(notes, dataclasses.replace(MINE, privileged=True)))
    known = knowledge()
    for tick in (0, 5):
        driver.act(observation_at(tick, known))
    driver.reset("next", 0)
    driver.act(observation_at(0, known))
    assert routes[0] is routes[1] and routes[2] is not routes[0]


def test_a_manifest_is_read_once() -> None:
    """A policy that declares itself privileged during an episode still gets no knowledge."""
    known: list[object] = []

    def greedy(observation: Observation) -> Command:
        known.append(observation.privileged)
        policy.manifest = Manifest(
            "mine", camera=None, privileged=True, waypoints=WaypointRule(dt_s=1e-9)
        )
        return STILL

    policy = FakePolicy(greedy)
    driver = PolicyCaller(policy)
    for tick in range(3):
        driver.act(observation_at(tick, knowledge()))
    assert known == [None] * 3 and driver.manifest == MINE


def test_a_forked_child_of_a_policy_does_not_continue_the_episode() -> None:
    """The child ends where the policy returns."""
    read, write = os.pipe()

    def forks(_: Observation) -> Command:
        os.fork()
        return STILL

    PolicyCaller(FakePolicy(forks)).act(observation_at())
    os.write(write, b"x")
    _, status = os.wait()
    assert os.read(read, 10) == b"x" and os.waitstatus_to_exitcode(status) == 1


def test_a_policy_at_work_is_timed() -> None:
    """Every query of a policy is timed, also one that fails; the first is marked."""
    calls: list[tuple[str, int] | None] = []

    class Notes:
        def starts(self, doing: PolicyCall, tick: int) -> None:
            calls.append((doing, tick))

        def stops(self) -> None:
            calls.append(None)

    driver = PolicyCaller(FakePolicy(lambda _: STILL), timer=Notes())
    driver.reset("a", 0)
    driver.act(observation_at(0))
    driver.act(observation_at(5))
    with pytest.raises(PolicyError):
        driver.reset("bad", 0)
    assert calls == [
        ("reset", 0),
        None,
        ("first act", 0),
        None,
        ("act", 5),
        None,
        ("reset", 0),
        None,
    ]


def test_a_policy_gets_copies_of_its_goal_and_further_pictures() -> None:
    """Picture and patch goals, depth, labels and further pictures are copies, and changes to its
    manifest have no effect."""
    ones = np.ones((4, 4), np.uint8)
    grey = np.full((4, 4, 3), 7, np.uint8)
    calibration = Calibration(np.eye(3), np.zeros(5), np.eye(4))
    left = CameraPicture(grey, ones, ones.astype(np.float32), calibration)
    full_observation = dataclasses.replace(
        observation_at(), depth=ones.astype(np.float32), labels=ones, pictures={"left": left}
    )
    manifest = dataclasses.replace(MINE, cameras={})

    def scribbles(observation: Observation) -> Command:
        goal = observation.goal
        own = observation.pictures["left"]
        assert (
            isinstance(goal, ImageGoal | RoutePatch)
            and own.depth is not None
            and own.labels is not None
        )
        for array in (
            goal.rgb if isinstance(goal, ImageGoal) else goal.pixels,
            observation.depth,
            observation.labels,
            own.rgb,
            own.depth,
            own.labels,
        ):
            assert array is not None
            array[:] = 99
        observation.pictures["right"] = own  # type: ignore[index]
        manifest.cameras["mast"] = CameraSpec(mount="mast")  # type: ignore[index]
        return STILL

    driver = PolicyCaller(FakePolicy(scribbles, manifest))
    for goal in (ImageGoal(grey), RoutePatch(ones)):
        driver.act(dataclasses.replace(full_observation, goal=goal))
    assert (
        (grey == 7).all()
        and (ones == 1).all()
        and (left.depth == 1).all()
        and (full_observation.depth == 1).all()
    )
    assert set(full_observation.pictures) == {"left"} and driver.manifest.cameras == {}


def after_reset(name: str, tick: int) -> Observation:
    return dataclasses.replace(observation_at(tick), episode=name, reset=True)


class RecordsCalls(FakePolicy):
    """Records its calls in order."""

    def __init__(self) -> None:
        super().__init__(lambda observation: self.noted("act"))
        self.calls: list[object] = []

    def noted(self, what: object) -> Command:
        self.calls.append(what)
        return STILL

    def on_reset(self) -> None:
        self.noted("on_reset")


class RecordsBatchCalls(RecordsCalls):
    """The same for many episodes."""

    def on_reset(self, episode_id: str) -> None:  # type: ignore[override]
        self.noted(("on_reset", episode_id))

    def ended(self, episode_id: str) -> None:
        self.noted(("ended", episode_id))

    def act_batch(self, observations: Sequence[Observation]) -> list[Command]:
        return [self.noted(one.episode) for one in observations]


def test_on_reset_comes_before_the_act_that_follows_a_teleport() -> None:
    """on_reset is called only before the act after a teleport; an error in it is a crash."""
    policy = RecordsCalls()
    driver = PolicyCaller(policy)
    for observation in (observation_at(0), after_reset("", 5), observation_at(10)):
        driver.act(observation)
    driver.ended()
    assert policy.calls == ["act", "on_reset", "act", "act"]
    assert PolicyCaller(FakePolicy(lambda one: Command(float(one.reset), 0.0))).act(
        after_reset("", 5)
    ) == Command(1.0, 0.0)
    policy.on_reset = lambda: [][0]  # type: ignore[method-assign]
    where = r"in test_driver\.py:\d+ \(on_reset at 0\.50 s\)"
    with pytest.raises(PolicyError, match=rf"raised IndexError: list index out of range {where}"):
        driver.act(after_reset("", 10))


def test_a_policy_for_many_episodes_gets_each_reset_and_end() -> None:
    """Also when queried one at a time, `on_reset` and `ended` are called once for each episode that
    has begun."""
    policy = RecordsBatchCalls()
    driver = PolicyCaller(policy)
    driver.ended()
    driver.reset("a", 0)
    driver.act(after_reset("a", 5))
    driver.ended()
    driver.ended()
    assert policy.calls == [("on_reset", "a"), "act", ("ended", "a")]
    assert driver.batches and not PolicyCaller(RecordsCalls()).batches


def test_an_ended_that_raises_is_printed_and_no_crash(capfd: pytest.CaptureFixture[str]) -> None:
    """An exception in `ended` is printed and is no crash, because the episode is over."""

    class Fails(RecordsBatchCalls):
        def ended(self, episode_id: str) -> None:
            raise LookupError("no such episode")

    driver = PolicyCaller(Fails())
    driver.reset("a", 0)
    driver.ended()
    assert "policy 'mine' raised LookupError: no such episode (ended)" in without_lines(
        capfd.readouterr().err
    )
