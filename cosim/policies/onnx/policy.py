"""Run the graph of an ONNX bundle as a policy."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from cosim.core.errors import PolicyError, UsageError
from cosim.core.npz import read_npz
from cosim.core.state import STILL, Command
from cosim.episode.control import command_of
from cosim.episode.interfaces import Observation
from cosim.episode.manifest_checks import calibration_of
from cosim.episode.policy_caller import LOAD_TIMEOUT_S
from cosim.policies.onnx.feeding import Feeder
from cosim.policies.onnx.graph import (
    NUMBERS,
    Graph,
    RunnableGraph,
    Tensor,
    runs_on_cpu,
    runtime_message,
)
from cosim.policies.onnx.inputs import StateInput
from cosim.policies.onnx.manifest import (
    EXAMPLE_FILE,
    MANIFEST_FILE,
    MAX_EXAMPLE_BYTES,
    BundleManifest,
    read_bundle_manifest,
)
from cosim.policies.onnx.outputs import PolicyAnswer, check_outputs, decode_answer
from cosim.policies.onnx.trial import TrialGraph
from cosim.policies.onnx.visnavkit import EXAMPLE, METADATA, find_exports, manifest_of_export
from cosim.policies.onnx.weights import bundle_files
from cosim.spec.camera import CameraPicture
from cosim.spec.goal import GOALS
from cosim.spec.manifest import Manifest
from cosim.spec.odometry import Odometry
from cosim.spec.robot import COURIER
from cosim.spec.sensors import AT_REST, NO_TRACKS, clear_scan


@dataclass(frozen=True)
class BundleLocation:
    """Folder and manifest of a bundle, and the path of its example."""

    folder: Path
    manifest: BundleManifest
    example: Path


def read_bundle(place: Path) -> BundleLocation:
    """Find the bundle in a folder, or visnavkit's export, in a folder or by the path of its graph.

    Raises UsageError if there is none or more than one; SpecError for an invalid manifest.
    """
    if (place / MANIFEST_FILE).exists():
        return BundleLocation(place, read_bundle_manifest(place), place / EXAMPLE_FILE)
    if place.is_file() and (place.parent / MANIFEST_FILE).exists():
        raise UsageError(f"{place}: is a file of the bundle {place.parent}: name that")
    exports = [place] if place.is_file() else find_exports(place)
    if len(exports) > 1:
        raise UsageError(
            f"{place}: has several bundles: name one of {', '.join(map(str, exports))}"
        )
    if not exports:
        raise UsageError(
            f"{place}: no bundle: has no {MANIFEST_FILE}, and no graph with a {METADATA} beside it"
        )
    return BundleLocation(
        exports[0].parent, manifest_of_export(exports[0]), exports[0].with_suffix(EXAMPLE)
    )


_GREY = 128
"""Value of all pixels of a grey picture."""


def onnx_policy(place: Path, within_s: float | None = LOAD_TIMEOUT_S) -> OnnxPolicy:
    """Load the policy of a bundle. Raises as `OnnxPolicy` does.

    It answers in batches if the graph's first axis is dynamic and it does not run on the CPU.
    """
    policy = OnnxPolicy(place, within_s)
    return (
        policy
        if policy.graph.on_cpu or not policy.takes_batches
        else OnnxBatchPolicy(place, within_s)
    )


class _Memory:
    """State of one episode."""

    def __init__(self, feeder: Feeder) -> None:
        self.feeder = feeder
        self.last: Command = STILL

    def clear(self) -> None:
        self.feeder.clear()
        self.last = STILL


class OnnxPolicy:
    """Policy of an ONNX bundle.

    The constructor checks the bundle and runs the graph once on grey pictures. Raises UsageError or
    SpecError if a file is missing or invalid.

    within_s: Timeout in seconds to load and run the graph in a child process first (`TrialGraph`);
        None if another process limits this one.
    bundle: The manifest.
    digest: Hash of the manifest, the weights and the outputs for grey pictures. Their last bits
        depend on the processor, which must not change within a run.
    example: Path of the bundle's example.
    """

    def __init__(self, place: Path, within_s: float | None = LOAD_TIMEOUT_S) -> None:
        found = read_bundle(place)
        self.bundle = found.manifest
        self.example = found.example
        self.manifest = found.manifest.policy
        self._files = files = bundle_files(found.folder, self.bundle)
        self._within_s = within_s if runs_on_cpu() else None
        inputs = self.bundle.inputs.values()
        states = [one.output for one in inputs if isinstance(one, StateInput)]
        self._names = [*dict.fromkeys([*self.bundle.output.outputs, *states])]
        with self.open_graph() as graph:
            self._check(graph)
            self._memory = _Memory(Feeder(self.bundle.inputs, graph.inputs, 0))
            answered = self._try(graph)
        self.graph = graph if isinstance(graph, Graph) else Graph(files.graph)
        digest = hashlib.blake2b(
            msgspec.json.encode(self.bundle) + files.digest.encode()
        ).hexdigest()
        self.digest = hashlib.blake2b(digest.encode() + answered).hexdigest()

    @property
    def takes_batches(self) -> bool:
        """Whether all inputs and outputs have a dynamic batch axis."""
        ports = [*self.graph.inputs.values(), *(self.graph.outputs[name] for name in self._names)]
        layouts = [getattr(one, "layout", "N") for one in self.bundle.inputs.values()]
        return all(port.shape[:1] == (None,) for port in ports) and all(
            layout.startswith("N") for layout in layouts
        )

    def reset(self, episode_id: str, seed: int) -> None:
        """Clear the history and seed noise inputs."""
        self._memory = self._begun(seed)

    def on_reset(self) -> None:
        """Clear the history."""
        self._memory.clear()

    def act(self, observation: Observation) -> PolicyAnswer:
        """Return waypoints (N, 2) or (N, 4) in units of the manifest's rule, or a command."""
        return self._answers(self.graph, [self._memory], [observation])[0]

    def open_graph(self) -> AbstractContextManager[Graph | TrialGraph]:
        """Return the graph in a child process; in this process if another one limits it."""
        if self._within_s is None:
            return nullcontext(Graph(self._files.graph))
        return TrialGraph(self._files.graph, self._files.size, self._within_s)

    def _begun(self, seed: int) -> _Memory:
        return _Memory(Feeder(self.bundle.inputs, self.graph.inputs, seed))

    def _answers(
        self, graph: RunnableGraph, memories: Sequence[_Memory], seen: Sequence[Observation]
    ) -> list[PolicyAnswer]:
        """Run the graph on one observation, or on a batch."""
        inputs = [memory.feeder.feed(one) for memory, one in zip(memories, seen, strict=True)]
        if len(inputs) == 1:
            outputs = [graph.run(inputs[0], self._names)]
        else:
            batch = {name: np.concatenate([one[name] for one in inputs]) for name in inputs[0]}
            together = graph.run(batch, self._names)
            outputs = [
                {name: array[i : i + 1] for name, array in together.items()}
                for i in range(len(inputs))
            ]
        return [self._answer(*each) for each in zip(memories, seen, outputs, strict=True)]

    def _answer(
        self, memory: _Memory, seen: Observation, outputs: Mapping[str, Tensor]
    ) -> PolicyAnswer:
        memory.feeder.remember(outputs)
        answer = decode_answer(self.bundle.output, outputs, seen.robot, memory.last)
        if isinstance(answer, Command):
            memory.last = answer
        return answer

    def _check(self, graph: RunnableGraph) -> None:
        """Raise UsageError unless the inputs of graph and manifest match and the outputs exist."""
        wanted = graph.inputs
        given = self.bundle.inputs
        if lacking := sorted(wanted.keys() - given.keys()):
            ports = "; ".join(f"'{name}' {wanted[name].in_words}" for name in lacking)
            raise UsageError(f"inputs: the graph wants {ports}, of which the manifest says nothing")
        if over := sorted(given.keys() - wanted.keys()):
            raise UsageError(
                f"inputs: the graph has no input '{over[0]}'. Valid choices: {', '.join(wanted)}"
            )
        check_outputs(self.bundle.output, graph.outputs)
        for name, one in given.items():
            if isinstance(one, StateInput) and one.output not in graph.outputs:
                choices = ", ".join(graph.outputs)
                raise UsageError(
                    f"inputs.{name}: the graph has no output '{one.output}'. Valid choices: "
                    f"{choices}"
                )

    def _try(self, graph: RunnableGraph) -> bytes:
        """Run the graph on grey pictures and return the bytes of its outputs.

        Raises UsageError if the runtime fails or the answer is invalid.
        """
        seen = example_observation(self.manifest)
        try:
            for _ in range(2):
                answer = self._answers(graph, [self._memory], [seen])[0]
                command_of(answer, rule=self.manifest.waypoints, robot=seen.robot)
            outputs = graph.run(self._memory.feeder.feed(seen), self._names)
            return b"".join(outputs[name].tobytes() for name in self._names)
        except UsageError:
            raise
        except PolicyError as error:
            raise UsageError(
                f"{graph.path}: in a grey street the policy {error}: are its weights intact?"
            ) from error
        except Exception as error:
            raise UsageError(
                f"{graph.path}: cannot be run by onnxruntime: {runtime_message(error)}"
            ) from error


class OnnxBatchPolicy(OnnxPolicy):
    """ONNX policy for several episodes at once (`cosim.episode.interfaces.BatchPolicy`)."""

    def __init__(self, place: Path, within_s: float | None = LOAD_TIMEOUT_S) -> None:
        super().__init__(place, within_s)
        self._memories: dict[str, _Memory] = {}

    def reset(self, episode_id: str, seed: int) -> None:
        """Begin an episode."""
        self._memories[episode_id] = self._begun(seed)

    def on_reset(self, episode_id: str = "") -> None:
        """Clear the history of an episode."""
        self._memories[episode_id].clear()

    def ended(self, episode_id: str) -> None:
        """Remove an episode."""
        self._memories.pop(episode_id, None)

    def act(self, observation: Observation) -> PolicyAnswer:
        return self.act_batch([observation])[0]

    def act_batch(self, observations: Sequence[Observation]) -> list[PolicyAnswer]:
        """Return the answer of `act` for each observation, up to the last bits."""
        return self._answers(
            self.graph, [self._memories[one.episode] for one in observations], observations
        )


def example_observation(manifest: Manifest) -> Observation:
    """Return an example observation: grey pictures, standing still, goal 10 m ahead."""

    def grey(size: tuple[int, int]) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        return np.full((size[1], size[0], 3), _GREY, np.uint8)

    goals = GOALS[manifest.goal].type
    return Observation(
        tick=0,
        time_s=0.0,
        rgb=None if manifest.camera is None else grey(manifest.picture_size),
        v_mps=0.0,
        w_radps=0.0,
        robot=COURIER,
        goal=None if goals is None else goals.example(manifest.picture_size),
        odometry=None if manifest.odometry == "none" else Odometry(0.0, 0.0, 0.0),
        scan=None if manifest.scan is None else clear_scan(manifest.scan),
        imu=None if manifest.imu == "none" else AT_REST,
        people=None if manifest.people == "none" else NO_TRACKS,
        pictures={
            name: CameraPicture(grey(one.size), None, None, calibration_of(one, COURIER))
            for name, one in manifest.cameras.items()
        },
    )


def example_differences(policy: OnnxPolicy) -> dict[str, float]:
    """Return the largest difference of each output in the bundle's example.

    Raises UsageError if the example is missing or does not fit the graph.
    """
    path = policy.example
    try:
        held: dict[str, Tensor] = read_npz(path, max_bytes=MAX_EXAMPLE_BYTES)
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error
    wanted = {
        name.removeprefix("expected."): array
        for name, array in held.items()
        if name.startswith("expected.")
    }
    if lacking := sorted(policy.graph.inputs.keys() - held.keys()):
        raise UsageError(f"{path}: has no array '{lacking[0]}'; it has {', '.join(held) or 'none'}")
    if unknown_ones := sorted(wanted.keys() - policy.graph.outputs.keys()):
        raise UsageError(
            f"{path}: has expected.{unknown_ones[0]}; the graph's outputs: "
            f"{', '.join(policy.graph.outputs)}"
        )
    for name, array in held.items():
        port = policy.graph.inputs.get(name)
        if array.dtype.kind not in NUMBERS or (port is not None and not port.takes(array)):
            wanted_is = f"the graph takes {port.in_words}" if port else "numbers are wanted"
            raise UsageError(
                f"{path}: does not fit the graph: '{name}' is {array.dtype.name} "
                f"{array.shape}, and {wanted_is}"
            )
    try:
        with policy.open_graph() as graph:
            found = graph.run({name: held[name] for name in graph.inputs}, list(graph.outputs))
    except UsageError:
        raise
    except Exception as error:
        raise UsageError(f"{path}: does not fit the graph: {runtime_message(error)}") from error
    for name, array in wanted.items():
        if found[name].shape != array.shape:
            raise UsageError(
                f"{path}: expected.{name} is {array.shape}, the graph returns {found[name].shape}"
            )
    return {
        name: float(np.abs(found[name].astype(float) - array).max(initial=0.0))
        for name, array in wanted.items()
    }
