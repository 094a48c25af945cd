"""Networks of gaits: values and bits, graphs, and refused files."""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import helper

from cosim.core.errors import CosimError, EngineError, PolicyError, SpecError, UsageError
from cosim.core.geometry import Pose
from cosim.core.network import (
    Dense,
    Lstm,
    Network,
    elu,
    exponential,
    network_of,
    tanh,
)
from cosim.core.state import Command
from cosim.policies.onnx.converting import Converter
from cosim.policies.onnx.graph import Graph
from cosim.policies.onnx.manifest import file_facts
from cosim.policies.onnx.torch_file import read_torch_file
from cosim.policies.onnx.weights import NetworkFile
from cosim.spec.robot import COURIER, DOG, WALKER, Legs
from physics.dynamics.drive import SUBSTEP_S, MeasuredBody
from physics.dynamics.drives import drive_of, gait_drive
from physics.dynamics.legs.balance import Balance, Stance
from physics.dynamics.legs.gait_file import published_gait, user_gait, weights_in_words
from physics.dynamics.legs.gait_graph import network_of_graph
from physics.dynamics.legs.leg_drive import LegDrive
from physics.dynamics.legs.walker import WALKER_NETWORK, walker_network
from physics.dynamics.world import BulletWorld
from physics.robots import urdf_path
from physics.robots.kinematics import centre_of_mass, link_tree
from physics.robots.walker import WALKER_MODEL
from scenarios.tools.bench.legs import FLAT
from tests.support.gaits import JOINTS, OBSERVATION, layers_graph, written_gait
from tests.support.graphs import graph_bytes, port

assert isinstance(DOG.drive, Legs) and isinstance(WALKER.drive, Legs)


def normal(seed: int, *shape: int) -> NDArray[np.float32]:
    return (0.3 * np.random.default_rng(seed).normal(size=shape)).astype(np.float32)


def walker_like() -> Network:
    """Return a random network of the walker's sizes."""
    lstm = Lstm(normal(1, 47 + 64, 256), normal(2, 256))
    layers = (
        Dense(normal(3, 64, 32), normal(4, 32), "elu"),
        Dense(normal(5, 32, 12), normal(6, 12), "linear"),
    )
    return Network((lstm, *layers))


def answers(network: Network, count: int = 50) -> NDArray[np.float32]:
    memory, found = network.empty_memory(), []
    for k in range(count):
        answer, memory = network.answer(normal(100 + k, network.sizes[0]), memory)
        found.append(answer)
    return np.array(found)


def test_a_network_matches_the_formulas_of_its_layers() -> None:
    """The answers of a recurrent network equal the formulas in float64."""
    network = walker_like()
    lstm, hidden, last = network.layers
    assert isinstance(hidden, Dense) and isinstance(last, Dense)
    output, cell = np.zeros(64), np.zeros(64)
    expected = []
    for k in range(50):
        given = np.concatenate([normal(100 + k, 47), output])
        gates = given @ lstm.weight.astype(float) + lstm.bias
        shares = 1.0 / (1.0 + np.exp(-gates))
        cell = shares[64:128] * cell + shares[:64] * np.tanh(gates[128:192])
        output = shares[192:] * np.tanh(cell)
        units = output @ hidden.weight.astype(float) + hidden.bias
        units = np.where(units > 0, units, np.expm1(units))
        expected.append(units @ last.weight.astype(float) + last.bias)
    assert np.abs(answers(network) - expected).max() < 1e-5


def test_activations_are_exact() -> None:
    """exp, tanh and ELU differ from those of numpy by less than a unit in the last place of
    float32."""
    x = np.linspace(-20.0, 20.0, 20001)
    assert np.abs(exponential(x[x <= 0]) / np.exp(x[x <= 0]) - 1.0).max() < 1e-10
    narrow = x.astype(np.float32)
    assert np.abs(tanh(narrow) - np.tanh(x)).max() < 1.2e-7
    assert np.abs(elu(narrow) - np.where(x > 0, x, np.expm1(x)))[x < 0].max() < 1.2e-7
    assert exponential(np.array([-1e9, 0.0])).tolist() == [exponential(np.array([-40.0]))[0], 1.0]


PROCESS = """
import cosim
from tests.physics.test_gait_networks import answers, hashed, walker_like
print(hashed(answers(walker_like())))
"""


def hashed(numbers: NDArray[Any]) -> str:
    return hashlib.blake2b(numbers.tobytes(), digest_size=8).hexdigest()


@pytest.mark.parametrize(
    "variables",
    [
        {"OPENBLAS_CORETYPE": "Haswell"},
        {"OPENBLAS_CORETYPE": "Nehalem"},
        {"NPY_DISABLE_CPU_FEATURES": "X86_V3"},
    ],
    ids=["haswell", "nehalem", "no-fma"],
)
def test_a_network_has_the_same_bits_on_every_processor(variables: dict[str, str]) -> None:
    """Other kernels of OpenBLAS, and numpy without AVX2 and fused multiply-adds, change no bit."""
    done = subprocess.run(
        [sys.executable, "-c", PROCESS],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == hashed(answers(walker_like()))


def test_a_network_is_restored_from_its_arrays() -> None:
    """Arrays that form no network are refused with the reason."""
    network = walker_like()
    restored = network_of(network.arrays())
    assert hashed(answers(restored)) == hashed(answers(network))
    arrays = network.arrays()
    for change, why in (
        ({"2.linear.bias": normal(1, 11)}, r"layer 2 has a weight \(32, 12\) and a bias \(11,\)"),
        ({"1.elu.weight": normal(1, 63, 32)}, "layer 1 takes 63 numbers, and layer 0 has 64"),
        ({"1.elu.bias": np.full(32, np.nan, np.float32)}, "layer 1 has weights that are NaN"),
        ({"1.elu.bias": np.zeros(32)}, "layer 1 has float32 and float64; expected float32"),
    ):
        with pytest.raises(ValueError, match=why):
            network_of(arrays | change)
    with pytest.raises(ValueError, match="has no weight and bias of layer 1"):
        network_of({name: one for name, one in arrays.items() if not name.startswith("1.")})


def normalised_graph() -> tuple[bytes, int]:
    """Return a graph with a normalised input, a layer as a product and a sum, and several
    activations, and the number of its inputs."""
    weights = {
        "mean": normal(1, 8),
        "std": np.abs(normal(2, 8)) + np.float32(0.5),
        "a": normal(3, 8, 6),
        "b": normal(4, 6),
        "c": normal(5, 4, 6),
        "d": normal(6, 4),
        "e": normal(7, 4, 3),
    }
    nodes = [
        helper.make_node("Flatten", ["obs"], ["flat"]),
        helper.make_node("Sub", ["flat", "mean"], ["m"]),
        helper.make_node("Div", ["m", "std"], ["n"]),
        helper.make_node("MatMul", ["n", "a"], ["p"]),
        helper.make_node("Add", ["b", "p"], ["q"]),
        helper.make_node("Tanh", ["q"], ["r"]),
        helper.make_node("Gemm", ["r", "c", "d"], ["s"], transB=1),
        helper.make_node("Relu", ["s"], ["t"]),
        helper.make_node("MatMul", ["t", "e"], ["actions"]),
    ]
    return graph_bytes(nodes, [port("obs", 1, 8)], [port("actions", 1, 3)], weights), 8


def test_a_graph_answers_as_in_its_runtime(tmp_path: Path) -> None:
    """Layers of all kinds, a normalised input, products and sums give the answers of
    onnxruntime."""
    for data, inputs in ((layers_graph(scale=0.3), 45), normalised_graph()):
        (tmp_path / "g.onnx").write_bytes(data)
        graph, network = Graph(tmp_path / "g.onnx"), network_of_graph(data)
        for k in range(5):
            given = 3.0 * normal(k, inputs)
            expected = graph.run({"obs": given[None]}, ["actions"])["actions"][0]
            assert network.answer(given, ())[0] == pytest.approx(expected, abs=1e-5)


def recurrent_graph() -> bytes:
    """Return a graph of an LSTM and a layer, with the memory as further inputs and outputs."""
    weights = {
        "w": normal(1, 1, 32, 5),
        "r": normal(2, 1, 32, 8),
        "b": normal(3, 1, 64),
        "c": normal(4, 3, 8),
        "axes": np.array([0]),
        "both": np.array([0, 1]),
    }
    nodes = [
        helper.make_node("Unsqueeze", ["obs", "axes"], ["one"]),
        helper.make_node(
            "LSTM",
            ["one", "w", "r", "b", "", "h_in", "c_in"],
            ["y", "h_out", "c_out"],
            hidden_size=8,
        ),
        helper.make_node("Squeeze", ["y", "both"], ["flat"]),
        helper.make_node("Gemm", ["flat", "c"], ["actions"], transB=1),
    ]
    memory = [port("h_in", 1, 1, 8), port("c_in", 1, 1, 8)]
    outputs = [port("actions", 1, 3), port("h_out", 1, 1, 8), port("c_out", 1, 1, 8)]
    return graph_bytes(nodes, [port("obs", 1, 5), *memory], outputs, weights)


def test_a_recurrent_graph_answers_as_in_its_runtime(tmp_path: Path) -> None:
    """With its memory as further inputs and outputs, the answers of several steps are those of
    onnxruntime."""
    data = recurrent_graph()
    (tmp_path / "g.onnx").write_bytes(data)
    graph, network = Graph(tmp_path / "g.onnx"), network_of_graph(data)
    state = network.empty_memory()
    held = {"h_in": np.zeros((1, 1, 8), np.float32), "c_in": np.zeros((1, 1, 8), np.float32)}
    for k in range(6):
        given = 3.0 * normal(10 + k, 5)
        found = graph.run({"obs": given[None], **held}, ["actions", "h_out", "c_out"])
        held = {"h_in": found["h_out"], "c_in": found["c_out"]}
        answer, state = network.answer(given, state)
        assert answer == pytest.approx(found["actions"][0], abs=1e-5)


def test_graphs_of_another_form_are_refused() -> None:
    """Unsupported operators, branches, ends and damaged files are refused with the reason."""
    ends = [port("obs", 1, 4)], [port("out", 1, 4)]
    held = {"w": normal(1, 4, 4), "v": normal(2, 4)}
    make = helper.make_node
    for nodes, why in (
        ([make("Softmax", ["obs"], ["out"])], "has an operator Softmax; possible are Gemm"),
        ([make("Elu", ["obs"], ["out"])], "Elu does not follow a layer"),
        ([make("MatMul", ["obs", "obs"], ["out"])], "its input 'obs' is no constant"),
        ([make("Mul", ["obs", "v"], ["out"])], "ends with a factor or a sum"),
        ([make("Identity", ["w"], ["out"])], "output 'out' does not follow from the input"),
        (
            [make("MatMul", ["obs", "w"], ["a"]), make("Gemm", ["obs", "w"], ["out"])],
            "is no chain: 'obs' is used by another Gemm",
        ),
        (
            [make("Gemm", ["obs", "w"], ["out"], alpha=0.5)],
            "Gemm has transA, alpha or beta",
        ),
    ):
        with pytest.raises(ValueError, match=why):
            network_of_graph(graph_bytes(nodes, *ends, held))
    for data in (b"", b"no graph", layers_graph()[:-40]):
        with pytest.raises(ValueError, match=r"graph|early|message|hold|input"):
            network_of_graph(data)


def test_malformed_graphs_are_refused() -> None:
    """Operators without inputs, constants with too few dimensions, and random changes of a file
    raise no other error."""
    ends = [port("obs", 1, 4)], [port("out", 1, 4)]
    held = {"w": normal(1, 4, 4), "v": normal(2, 4), "s": np.float32(1.0)}
    make = helper.make_node
    for nodes in (
        [make("LSTM", [], ["out"])],
        [make("LSTM", ["obs", "s", "s", "s"], ["out"])],
        [make("LSTM", ["obs", "v", "v", "v"], ["out"])],
        [make("LSTM", ["obs", "w", "w", "w"], ["out"])],
        [make("Gemm", ["obs", "s", "s"], ["out"])],
        [make("Gemm", ["obs", "w", "w"], ["out"])],
    ):
        with pytest.raises(ValueError, match=r"LSTM|Gemm|output|layer"):
            network_of_graph(graph_bytes(nodes, *ends, held))
    constant = make("Constant", [], [], value=helper.make_tensor("c", 1, [1], [0.0]))
    with pytest.raises(ValueError, match="Constant has no output"):
        network_of_graph(graph_bytes([constant], *ends, held))
    draws, sound = np.random.default_rng(0), recurrent_graph()
    for _ in range(500):
        data = bytearray(sound)
        for at in draws.integers(0, len(data), 3).tolist():
            data[at] = int(draws.integers(256))
        with contextlib.suppress(ValueError, RecursionError), np.errstate(all="ignore"):
            network_of_graph(bytes(data))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        (
            {"joints": JOINTS | {"tail": JOINTS["rear_left_hip"]}},
            "joints has 'tail', which robot 'dog' l",
        ),
        (
            {"joints": JOINTS | {"front_left_knee": JOINTS["rear_left_hip"]}},
            r"rear_right_calf. Did you mean front_left_\w+\?$",
        ),
        ({"joints": dict(list(JOINTS.items())[1:])}, "joints lacks front_left_hip of robot 'dog'"),
        (
            {"balance": {"ankles": ["front_left_calf", "front_right_calf"], "sole_m": 0.0}},
            "balance is for robots with two feet, and robot 'dog' has 4",
        ),
        ({"rate_hz": 30}, "rate_hz is 30: an interval must be a multiple of the substep of 5 ms"),
        ({"observation": OBSERVATION[1:]}, "takes 45 numbers, and the observation .* has 42"),
        (
            {"observation": [OBSERVATION[0], {"what": "gravty"}]},
            r"'gravty' - at `\$.observation\[1\]`. Valid choices: .*Did you mean gravity\?",
        ),
        ({"robot": "walker"}, "is a gait of robot 'walker', not of 'dog'"),
        ({"model": "other.onnx"}, "other.onnx"),
        (
            {
                "joints": JOINTS
                | {"front_left_hip": {"rest_rad": 0, "kp": 9e9, "kd": 1, "scale": 1}}
            },
            r"json: kp must be in \[0, 2000\], not 9000000000.0 - at `\$.joints.front_left_hip`",
        ),
        ({"files": {"tiny.onnx": {"bytes": 7, "blake2b": "0" * 64}}}, "expected tiny.onnx"),
    ],
    ids=[
        "unknown",
        "similar",
        "missing",
        "balance",
        "rate",
        "sizes",
        "term",
        "robot",
        "model",
        "gain",
        "hash",
    ],
)
def test_a_gait_that_does_not_fit_its_robot_is_refused(
    changes: dict[str, Any], why: str, tmp_path: Path
) -> None:
    """The message names the file, the field and the valid values."""
    path = written_gait(tmp_path, **changes)
    with pytest.raises(CosimError, match=why) as caught:
        user_gait(f"onnx:{path}", DOG, SUBSTEP_S)
    assert str(tmp_path) in str(caught.value)


def test_a_gait_is_named_by_its_graph(tmp_path: Path) -> None:
    """Other names, missing files and robots on wheels are refused."""
    path = written_gait(tmp_path)
    assert user_gait(f"onnx:{path}", DOG, SUBSTEP_S).network.sizes == (45, 12)
    for name, robot, why in (
        (f"{path}", DOG, "use onnx:FILE.onnx"),
        (f"onnx:{tmp_path}/none.onnx", DOG, "none.onnx does not exist"),
        (f"onnx:{path}", COURIER, "robot 'courier' has wheels; with legs are dog, walker"),
    ):
        with pytest.raises(UsageError, match=why):
            user_gait(name, robot, SUBSTEP_S)
    path.with_suffix(".json").unlink()
    with pytest.raises(SpecError, match=r"tiny\.json: cannot be read"):
        user_gait(f"onnx:{path}", DOG, SUBSTEP_S)


FOUND = {
    name: rf"tiny\.onnx: .* bytes, .*; expected tiny\.onnx: .*\. Different: {words}$"
    for name, words in (("bytes", "size"), ("blake2b", "BLAKE2b"), ("sha256", "SHA-256"))
}
"""Error messages for a file with another size or hash."""


@pytest.mark.parametrize("wrong", ["bytes", "blake2b", "sha256"])
@pytest.mark.parametrize("names", [("blake2b",), ("sha256",), ("blake2b", "sha256")])
def test_each_hash_that_a_manifest_gives_is_checked(
    tmp_path: Path, names: tuple[str, ...], wrong: str
) -> None:
    """The right file loads by either hash, and another size or hash is refused."""
    facts = file_facts(layers_graph())
    given: dict[str, Any] = {"bytes": facts.bytes, **{name: facts.hashes[name] for name in names}}
    path = written_gait(tmp_path, files={"tiny.onnx": given})
    assert user_gait(f"onnx:{path}", DOG, SUBSTEP_S).network.sizes == (45, 12)
    if wrong in given:
        given[wrong] = 1 if wrong == "bytes" else "0" * 64
        path = written_gait(tmp_path, files={"tiny.onnx": given})
        with pytest.raises(UsageError, match=FOUND[wrong]):
            user_gait(f"onnx:{path}", DOG, SUBSTEP_S)


def test_speeds_of_a_gait_are_averaged_over_its_own_cycle(tmp_path: Path) -> None:
    """The cycle is that of the manifest, the longest period of a phase, or the robot's."""
    assert isinstance(DOG.drive, Legs)
    phases = [{"what": "phase", "period_s": period_s} for period_s in (0.4, 0.7)]
    for terms, changes, cycle_s in (
        ([], {}, DOG.drive.cycle_s),
        (phases, {}, 0.7),
        (phases, {"cycle_s": 0.5}, 0.5),
    ):
        graph = layers_graph(sizes=(45 + 2 * len(terms), 12))
        path = written_gait(tmp_path, graph, observation=[*OBSERVATION, *terms], **changes)
        drive = gait_drive(DOG, user_gait(f"onnx:{path}", DOG, SUBSTEP_S))
        assert drive.cycle_s == cycle_s
        with BulletWorld(FLAT, robot=DOG, drive=drive) as world:
            world.place(Pose(0.0, 0.0, 0.0))
            assert world._leg_monitor is not None and world._leg_monitor._count == round(
                cycle_s / SUBSTEP_S
            )


def still_body(**changes: Any) -> MeasuredBody:
    """Return a dog at rest."""
    assert isinstance(DOG.drive, Legs)
    rest = DOG.drive.rest_rad
    level = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    zero = (0.0, 0.0, 0.0)
    return MeasuredBody(zero, level, zero, zero, rest, (0.0,) * 12)._replace(**changes)


def test_invalid_answers_of_a_users_gait_are_policy_errors(
    tmp_path: Path,
) -> None:
    """NaN answers name the gait, and torques far beyond the limit name joint and limit."""
    path = written_gait(tmp_path, layers_graph(scale=1e30))
    drive = gait_drive(DOG, user_gait(f"onnx:{path}", DOG, SUBSTEP_S))
    with (
        np.errstate(all="ignore"),
        pytest.raises(PolicyError, match=r"gait 'tiny' answered (nan|-?inf) for front_left_hip"),
    ):
        drive.step(Command(1.0, 0.0), still_body())
    strong = {name: row | {"kp": 2000, "scale": 1000} for name, row in JOINTS.items()}
    gait = user_gait(f"onnx:{written_gait(tmp_path, joints=strong)}", DOG, SUBSTEP_S)
    drive = gait_drive(DOG, gait)
    with pytest.raises(PolicyError, match=r"joint front_left_hip is .* Nm; its limit is 23.7 Nm"):
        drive.step(Command(1.0, 0.0), still_body())


class ConstantTorques:
    """A gait of constant torques."""

    cycle_s = 0.2

    def __init__(self, torque_nm: float) -> None:
        self._torques_nm = [torque_nm] * 12

    def reset(self) -> None:
        pass

    def step(self, command: Command, body: MeasuredBody) -> list[float]:
        return self._torques_nm


def test_a_shipped_gait_is_clamped_and_its_nan_is_an_engine_error() -> None:
    """A tumbling robot demands more than the limits, which is clamped; NaN is no fault of a
    policy."""
    assert isinstance(DOG.drive, Legs)
    tumbles = still_body(speeds_radps=(1e4,) * 12)
    torques = drive_of(DOG, SUBSTEP_S).step(Command(1.0, 0.0), tumbles).values
    assert torques == [-most for most in DOG.drive.torque_nm]
    for torque_nm in (math.inf, -math.inf):
        strong = LegDrive(DOG, DOG.drive, SUBSTEP_S, ConstantTorques(torque_nm))
        assert strong.step(Command(1.0, 0.0), still_body()).values[0] == math.copysign(
            23.7, torque_nm
        )
    broken = LegDrive(DOG, DOG.drive, SUBSTEP_S, ConstantTorques(math.nan))
    with pytest.raises(EngineError, match="torque of joint front_left_hip is nan Nm"):
        broken.step(Command(1.0, 0.0), still_body())


def test_the_posture_of_the_walker_at_rest_is_balanced() -> None:
    """Its feet are level on the ground, and the centre of mass is over the middle of the soles."""
    assert isinstance(WALKER.drive, Legs)
    rest = dict(zip(WALKER.drive.joints, WALKER.drive.rest_rad, strict=True))
    frames = link_tree(urdf_path(WALKER)).frames(rest)
    for side, left in (("left", 1.0), ("right", -1.0)):
        turn, (x, y, z) = frames[f"{side}_foot"]
        assert z - 0.035 == pytest.approx(-WALKER.drive.stand_m, abs=1e-3)
        assert y == pytest.approx(left * 0.1185, abs=1e-3)
        assert turn[2][2] == pytest.approx(1.0)
        assert centre_of_mass(WALKER_MODEL, frames)[0] - x == pytest.approx(0.035, abs=0.003)


def test_a_robot_that_is_upside_down_does_not_balance() -> None:
    """It does not balance with its centre of mass below the ankles."""
    assert isinstance(WALKER.drive, Legs)
    stance = Stance(("left_ankle_pitch", "right_ankle_pitch"), 0.035, (0.0,) * 12, (0.0,) * 12)
    balance = Balance(WALKER_MODEL, link_tree(urdf_path(WALKER)), WALKER.drive, stance)
    body = still_body(angles_rad=WALKER.drive.rest_rad)
    balance.begin(body)
    assert balance.holds(body)
    over = list(WALKER.drive.rest_rad)
    over[0] = over[6] = math.pi
    body = still_body(angles_rad=tuple(over))
    balance.begin(body)
    assert not balance.holds(body)


def test_a_missing_network_of_the_walker_is_named_with_its_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message has file, size, hash, source and the command that converts it."""
    monkeypatch.setenv("COSIM_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert isinstance(WALKER.drive, Legs) and WALKER_NETWORK.weights.facts is not None
    with pytest.raises(UsageError) as caught:
        published_gait(WALKER, WALKER.drive, SUBSTEP_S)
    message = str(caught.value)
    assert "robot 'walker': walker.npz is missing, 126154 bytes, BLAKE2b 085c4b6c" in message
    assert "https://github.com/unitreerobotics/unitree_rl_gym/raw/276801e46c5d4335" in message
    assert f"145745 bytes, SHA-256 {WALKER_NETWORK.weights.facts.sha256}" in message
    assert "`python -m physics.dynamics.legs.walker motion.pt`" in message and "\n" not in message
    assert weights_in_words(WALKER) == ", weights missing (walker.npz)"
    (tmp_path / "walker.npz").write_bytes(b"another")
    with pytest.raises(UsageError, match=r"walker\.npz: 7 bytes, .*expected walker\.npz"):
        published_gait(WALKER, WALKER.drive, SUBSTEP_S)


def test_the_converter_writes_the_file_that_runs_use(walker_folder: Path) -> None:
    """The converted file has the size that the manifest states."""
    facts = WALKER_NETWORK.graph().facts
    assert facts is not None
    assert (walker_folder / "walker.npz").stat().st_size == facts.bytes


def test_a_converter_writes_into_the_folder_of_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It writes to $COSIM_WEIGHTS, where a run looks, or to the folder of -o."""
    monkeypatch.setenv("COSIM_WEIGHTS", str(tmp_path / "weights"))
    (tmp_path / "a.pt").write_bytes(b"a")
    files = [NetworkFile(name, "", None) for name in ("a.pt", "a.npz")]
    converter = Converter("tests.a", files[0], bytes, lambda: files[1])
    converter.command([str(tmp_path / "a.pt")])
    converter.command([str(tmp_path / "a.pt"), "-o", str(tmp_path / "other")])
    assert [(tmp_path / name / "a.npz").is_file() for name in ("weights", "other")] == [True] * 2


def test_the_converter_refuses_another_file(tmp_path: Path) -> None:
    """Neither another file nor arrays of another network are converted."""
    (tmp_path / "motion.pt").write_bytes(b"no weights")
    with pytest.raises(UsageError, match=r"motion\.pt: 10 bytes, .*expected motion\.pt of https:"):
        WALKER_NETWORK.write(tmp_path / "motion.pt", tmp_path)
    with pytest.raises(ValueError, match=r"has no 'memory\.weight_ih_l0'"):
        walker_network({})
    with pytest.raises(ValueError, match="is no PyTorch file of weights"):
        read_torch_file(b"PK\x03\x04 and no more")
