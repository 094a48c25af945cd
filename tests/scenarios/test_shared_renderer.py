"""One renderer for many environments: equal pictures, labels and hashes, also after processes
die."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
import shapely

from bridge.policy_server import (
    ActReply,
    ActRequest,
    EpisodeReply,
    PolicyReply,
    Refusal,
    ResetRequest,
    decode_reply,
)
from cosim.core.errors import EngineError, PolicyError, RendererLost, UsageError
from cosim.core.framing import MessageSocket
from cosim.core.geometry import Polyline, Pose
from cosim.core.state import NO_VEHICLES, Frame, People, RobotState, Street
from cosim.episode.interfaces import Observation, Policy, Privileged
from cosim.episode.policy_caller import PolicyCaller
from cosim.policies.load import load_policy
from cosim.results.log import Log
from cosim.results.run_folder import read_records, read_spec
from cosim.spec.camera import CameraSpec
from cosim.spec.episode_id import episode_id_of
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import COURIER
from cosim.spec.scenario import CityMap, Light, Scenario, Suite, write_suite
from scenarios.ipc.deadlines import Patience
from scenarios.ipc.messages import EpisodeProgress, Hello
from scenarios.ipc.observation_codec import encode_constants, encode_observation
from scenarios.ipc.render_link import RendererLink
from scenarios.ipc.render_protocol import Draw, Rendered, Request, encode_exchange
from scenarios.ipc.shared_memory import SharedMemory
from scenarios.places.nets import place
from scenarios.runs import run as suite_run
from scenarios.runs.policy_host import shared_caller
from scenarios.runs.shared_renderer import RendererEnd, SharedRenderer, check_shared
from scenarios.tools.bench.cameras import busy_street
from scenarios.tools.verify.doctor import small_scenario
from tests.conftest import Cosim, without_lines
from tests.support.shared_policies import NOTES, Knowing, Seeing, Together

OF = "tests.support.shared_policies"
FRAMES = EpisodeOptions(seed=7, frames_every_s=0.5)


def scenarios_of(*names: str) -> tuple[Scenario, ...]:
    """Return a second of a long way in a small city, with another crowd for each name."""
    one = msgspec.structs.replace(small_scenario(), time_limit_s=1.0)
    return tuple(msgspec.structs.replace(one, id=name, seed=i) for i, name in enumerate(names))


def suite_of(*names: str) -> Suite:
    return Suite(name="small", version="1", scenarios=scenarios_of(*names))


@contextmanager
def renderer_for(
    folder: Path, policy: Policy, patience: Patience = Patience()
) -> Iterator[SharedRenderer]:
    """Start a renderer in another process, without a run."""
    name = f"{OF}:{type(policy).__name__}"
    driver = load_policy(name)
    hello = Hello(name, driver.manifest, driver.source_hash, patience=patience)
    with SharedRenderer(folder, hello, asks=driver.batches) as renderer:
        yield renderer


def shared_files() -> set[str]:
    """Return the names in /dev/shm, without semaphores, which other processes make."""
    return {path.name for path in Path("/dev/shm").iterdir() if not path.name.startswith("sem.")}


def linked(renderer: SharedRenderer) -> RendererLink:
    return RendererLink(renderer.at.address)


def renderer_pid() -> int:
    """Return the drawing process: the child of a shepherd of this process that serves pictures."""
    found = [
        int(child)
        for shepherd in children(os.getpid())
        for child in children(shepherd)
        if b"serve_pictures" in Path(f"/proc/{shepherd}/cmdline").read_bytes()
    ]
    return found[-1]


def children(pid: int) -> list[int]:
    """Return the processes that the threads of a process have started."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return sorted(int(child) for task in tasks for child in (task / "children").read_text().split())


def replies_together(links: Sequence[RendererLink], *requests: Request) -> list[bytes]:
    """Return the replies to requests that arrive together, as the renderer is stopped while they
    are sent."""
    pid = renderer_pid()
    os.kill(pid, signal.SIGSTOP)
    while Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "T":
        time.sleep(0.001)
    for link, request in zip(links, requests, strict=True):
        link.send(request)
    os.kill(pid, signal.SIGCONT)
    return [link.received() for link in links]


def separate_frames(
    scenarios: Sequence[Scenario], robot: RobotState, streets: Sequence[Street]
) -> list[list[Frame]]:
    """Return the frames of a separate camera for each of some scenarios in one place."""
    from cosim.spec.robot import robot_called
    from physics.cameras.gl.camera import GlCamera
    from physics.dynamics.world import BulletWorld
    from physics.street.street_surface import StreetSurface

    spec = Seeing.manifest.camera
    where = scenarios[0].place
    surface = StreetSurface(place(where)[1], where.seed)
    found = []
    for scenario in scenarios:
        world = BulletWorld(surface, scenario.barriers, robot_called(scenario.robot))
        light, weather = scenario.light, scenario.conditions
        with GlCamera(world, spec, light=light, weather=weather) as camera:
            found.append([camera.render(robot, street) for street in streets])
    return found


@pytest.mark.engine
def test_pictures_and_labels_equal_those_of_separate_cameras(tmp_path: Path) -> None:
    """Environments with other robots, lights and weathers are drawn together, also when one ends or
    sends an invalid message. No file is left in /dev/shm, and a killed renderer is noticed."""
    before = shared_files()
    (one,) = scenarios_of("one")
    fog = Light(fog_m=40.0)
    other = msgspec.structs.replace(
        one, id="other", robot="scout", light=fog, weather="rainy_night"
    )
    busy = busy_street(place(one.place)[1], persons=20, frames=4)
    expected = separate_frames((one, other), busy.robot, busy.streets)
    with renderer_for(tmp_path, Seeing()) as renderer:
        links = [linked(renderer) for _ in range(3)]
        for link, each in zip(links, (one, other, other), strict=True):
            link.enter(each)
        for k, street in enumerate(busy.streets):
            replies = replies_together(links, *[Draw(busy.robot, street)] * len(links))
            for link, reply, frames in zip(links, replies, expected, strict=False):
                picture = link.decode_frame(reply)
                assert picture.rgb.tobytes() == frames[k].rgb.tobytes()
                assert frames[k].labels is not None and picture.labels is not None
                assert picture.labels.tobytes() == frames[k].labels.tobytes()
            if k == 1:
                links.pop().close()
            if k == 2:
                links.pop().send(ResetRequest("", "no policy is here", "", 0))
        assert expected[0][3].rgb.tobytes() != expected[1][3].rgb.tobytes() and len(links) == 1
        with pytest.raises(
            EngineError, match="the shared renderer: UsageError: unknown map 'nowhere'"
        ):
            linked(renderer).enter(msgspec.structs.replace(one, place=CityMap(map="nowhere")))
        pid = renderer_pid()
        renderer.check()
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(RendererLost) as lost:
            links[0].draw(busy.robot, busy.streets[0])
        assert (lost.value.number, lost.value.asked) == (1, "")
        end = renderer.end_of(1)
        assert end is not None and end.words == "the renderer process was killed by SIGKILL"
    assert shared_files() == before


def test_an_environment_reports_that_it_waits_for_the_renderer() -> None:
    """While the renderer loads its policy it accepts no connection, and the environment is not
    taken for one that hangs."""
    address = f"cosim-test-{os.getpid()}"
    memory = SharedMemory.new()
    waited = []
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(f"\0{address}")
        listening.listen()

        def accept() -> None:
            end, _ = listening.accept()
            waited.append(end)
            socket.send_fds(end, [b"\0"], [memory.descriptor])
            MessageSocket(end).send(encode_exchange(Rendered(1, "late")))

        link = RendererLink(address, accept, waiting_every_s=0.01)
        link.enter(small_scenario())
        assert (link.number, link.renderer, len(waited)) == (1, "late", 1)
        link.close()
    memory.close()


def request_at(name: str, step: int) -> ActRequest:
    """Return the request of the environment of a blind policy at a step."""
    people = People.of(("c1",), [[3.0, 0.0]], [0.0], [1.0], ("walk",))
    robot = RobotState(Pose(0.0, 0.0, 0.0), 0.5)
    route = Polyline([(0.0, 0.0), (30.0, 0.0)])
    known = Privileged(
        robot, route, 0.0, people, NO_VEHICLES, {}, (), shapely.box(0.0, -1.0, 30.0, 1.0)
    )
    seen = Observation(5 * step, 0.25 * step, None, 0.5, 0.0, COURIER, known)
    fields, _ = encode_observation(seen)
    return ActRequest(
        "r", name, "a", step, **fields, about=None if step else encode_constants(seen)
    )


@pytest.mark.engine
def test_a_failed_batch_names_the_queried_episodes(tmp_path: Path) -> None:
    """An error in act_batch crashes all its episodes; a policy that ends the renderer costs an
    attempt only of the queried ones."""
    with renderer_for(tmp_path, Knowing(), Patience(answer_s=1.0)) as renderer:

        def started(*names: str) -> list[RendererLink]:
            links = [linked(renderer) for _ in names]
            for link, name in zip(links, names, strict=True):
                assert decode_reply(link.exchange(ResetRequest("r", name, "a", 0))) == EpisodeReply(
                    "r", name, "a"
                )
            for step in (0, 1):
                replies = answers(links, names, step)
                assert replies == [ActReply("r", name, "a", step, 0.59, 0.0) for name in names]
            return links

        def answers(
            links: Sequence[RendererLink], names: Sequence[str], step: int
        ) -> list[PolicyReply]:
            requests = [request_at(name, step) for name in names]
            return [decode_reply(reply) for reply in replies_together(links, *requests)]

        names = "honest", "raises"
        refused = Refusal("policy", "raised KeyError: 'no such weight'", together=2)
        replies = answers(started(*names), names, 2)
        assert [
            msgspec.structs.replace(reply, words=without_lines(reply.words)) for reply in replies
        ] == [refused] * 2
        driver = shared_caller(Knowing.manifest, "", renderer.at, "r")
        with pytest.raises(
            PolicyError, match=r"policy 'knowing' raised FileNotFoundError: weights\.pt.* \(reset\)"
        ):
            driver.reset("fails-in-reset", 0)
        renderer.check()
        ends = {
            "hangs": RendererEnd("the renderer process was ended", 1.0),
            "exits": RendererEnd(
                "the renderer process ended with exit code 7 in the policy's act at 0.50 s"
            ),
            "closes": RendererEnd("the renderer process ended with exit code 1"),
        }
        for number, (name, end) in enumerate(ends.items(), start=1):
            honest_one, other = started("honest", name)
            other.send(request_at(name, 2))
            while name == "hangs" and renderer.end_of(1) is None:
                renderer.check()
            with pytest.raises(RendererLost) as lost:
                other.received("act at 0.50 s")
            assert lost.value.asked == "act at 0.50 s"
            with pytest.raises(RendererLost) as lost:
                honest_one.received("act at 0.50 s")
            assert lost.value.asked == ""
            assert renderer.end_of(number) == end


@pytest.fixture(scope="module")
def separate_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run of two episodes in this process, each with its own camera."""
    folder = tmp_path_factory.mktemp("runs") / "own"
    suite_run.run(suite_of("a", "b"), Seeing(), out=folder, options=FRAMES)
    return folder


def same_runs(first: Path, second: Path) -> bool:
    """Return whether two runs have the same hashes, and the same frames to the byte."""
    hashes = [
        {record.scenario.id: record.state_hash for record in read_records(folder)}
        for folder in (first, second)
    ]
    frames = [
        {p.relative_to(f): p.read_bytes() for p in f.glob("episodes/*/frames/*.png")}
        for f in (first, second)
    ]
    assert len(set(hashes[0].values())) == 2 and len(frames[0]) == 4
    return hashes[0] == hashes[1] and frames[0] == frames[1]


@pytest.mark.engine
def test_a_run_with_a_shared_renderer_equals_one_with_separate_cameras(
    separate_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cosim: Cosim
) -> None:
    """Two processes whose pictures and answers come from a third have the state hashes and frames
    of separate episodes. run.json names the mode, and one process puts all queries."""
    monkeypatch.setenv(NOTES, str(tmp_path / "notes"))
    write_suite(suite_of("a", "b"), tmp_path / "small.json")
    words = ("--policy", f"{OF}:Together", "--frames", "0.5", "--seed", "7", "--out", "shared")
    done = cosim("run", "small.json", *words, "--jobs", "2", "--shared-renderer", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (
        same_runs(separate_run, tmp_path / "shared")
        and read_spec(tmp_path / "shared").shared_renderer
    )
    notes = [line.split() for line in (tmp_path / "notes").read_text().splitlines()]
    ended = [line[1] for line in notes if line[0] == "ended"]
    queries = [line for line in notes if line[0] != "ended"]
    assert len({line[0] for line in queries}) == 1 and sum(len(line) - 1 for line in queries) == 8
    called = {episode_id_of(7, scenario).episode for scenario in scenarios_of("a", "b")}
    assert (
        set(ended) == {name for line in queries for name in line[1:]} == called and len(ended) == 2
    )
    assert cosim("run", "small.json", *words, "--resume", cwd=tmp_path).returncode == 0


@pytest.mark.engine
def test_a_policy_in_the_shared_renderer_gets_the_same_observations(tmp_path: Path) -> None:
    """With picture goals, labels, odometry and calibration it reaches the state hash and the
    waypoints of a run with its own camera."""
    guided = f"{OF}:Guided"
    one = EpisodeOptions(seed=7)
    suite_run.run(suite_of("a"), guided, out=tmp_path / "own", options=one)
    suite_run.run(suite_of("a"), guided, shared_renderer=True, out=tmp_path / "shared", options=one)
    (own,) = read_records(tmp_path / "own")
    (shared,) = read_records(tmp_path / "shared")
    assert (own.status, own.manifest.goal, own.manifest.odometry) == ("done", "image", "wheel")
    assert own.state_hash == shared.state_hash and shared.status == "done"
    mine, theirs = ((tmp_path / how / "episodes/a/trajectory.npz") for how in ("own", "shared"))
    assert mine.read_bytes() == theirs.read_bytes() and {*Log.load(mine).plan_sizes.tolist()} == {
        0,
        4,
    }


@pytest.mark.engine
def test_episodes_whose_renderer_is_killed_are_run_again(
    separate_run: Path, tmp_path: Path
) -> None:
    """After kill -9 in the middle of two episodes another renderer draws them from the start, with
    equal results and no crash."""
    killed: list[int] = []

    def kill(message: object) -> None:
        if isinstance(message, EpisodeProgress) and not killed:
            killed.append(renderer_pid())
            os.kill(killed[0], signal.SIGKILL)

    folder = tmp_path / "run"
    suite_run.run(
        suite_of("a", "b"),
        f"{OF}:Seeing",
        jobs=2,
        shared_renderer=True,
        out=folder,
        options=FRAMES,
        tell=kill,
    )
    assert killed and same_runs(separate_run, folder)
    logs = sorted(path.name for path in (folder / "logs").iterdir())
    assert logs == ["renderer-0.log", "renderer-1.log", "worker-0.log", "worker-1.log"]


def test_a_run_with_nothing_to_share_is_refused() -> None:
    """A blind policy without act_batch, a camera that is not gl, other pictures and a policy object
    are refused with the reason."""
    check_shared(PolicyCaller(Together()), "gl")
    check_shared(PolicyCaller(Seeing()), "gl")
    check_shared(PolicyCaller(Knowing()), "bullet")
    with pytest.raises(
        UsageError,
        match="policy 'orca' has no camera and no method 'act_batch': leave --shared-rend",
    ):
        check_shared(load_policy("orca"), "bullet")
    with pytest.raises(
        UsageError, match="draws by OpenGL, not by the bullet camera: use --camera gl"
    ):
        check_shared(PolicyCaller(Seeing()), "bullet")
    deep = Manifest("deep", camera=CameraSpec(depth=True))
    wide = Manifest("wide", cameras={"left": CameraSpec(mount="left")})
    for manifest, words in (
        (deep, "'deep' asks for depth"),
        (wide, "'wide' asks for further cameras"),
    ):
        with pytest.raises(
            UsageError, match=f"policy {words}, which a shared renderer does not give"
        ):
            check_shared(PolicyCaller(Seeing(), manifest), "gl")
    with pytest.raises(UsageError, match="shared_renderer=True needs a policy by its name"):
        suite_run.run(suite_of("a"), Together(), shared_renderer=True)


def test_shared_memory_cannot_be_resized() -> None:
    """Its size is sealed, and a picture that was read does not change when the next one is
    written."""
    memory = SharedMemory.new(64)
    with pytest.raises(PermissionError):
        os.ftruncate(memory.descriptor, 0)
    with pytest.raises(ValueError, match="no space for rgb"):
        memory.write_arrays({"rgb": np.zeros((9, 9), np.uint8)})
    picture = {"rgb": np.arange(24, dtype=np.uint8).reshape(2, 4, 3)}
    taken = memory.read_arrays(memory.write_arrays(picture))
    memory.write_arrays({"rgb": picture["rgb"] + 1})
    assert (taken["rgb"] == picture["rgb"]).all() and not memory.busy
    memory.close()
