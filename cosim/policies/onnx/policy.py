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
from cosim.episode.policy_caller import LOADED_WITHIN_S
from cosim.policies.onnx.feeding import Feeder
from cosim.policies.onnx.graph import (
    NUMBERS,
    AskedGraph,
    Graph,
    Tensor,
    runs_on_cpu,
    said_by_runtime,
)
from cosim.policies.onnx.inputs import StateInput
from cosim.policies.onnx.manifest import (
    EXAMPLE_FILE,
    MANIFEST_FILE,
    MOST_EXAMPLE_BYTES,
    BundleManifest,
    read_bundle_manifest,
)
from cosim.policies.onnx.outputs import PolicyAnswer, answer_of, check_outputs
from cosim.policies.onnx.trial import TrialGraph
from cosim.policies.onnx.visnavkit import EXAMPLE, METADATA, exports_in, manifest_of_export
from cosim.policies.onnx.weights import bundle_files
from cosim.spec.camera import CameraPicture
from cosim.spec.goal import GOALS
from cosim.spec.manifest import Manifest
from cosim.spec.odometry import Odometry
from cosim.spec.robot import COURIER


@dataclass(frozen=True)
class FoundBundle:
    """A bundle: its folder, its manifest, and where an example of it would be."""

    folder: Path
    manifest: BundleManifest
    example: Path


def read_bundle(place: Path) -> FoundBundle:
    """The bundle in a folder; or visnavkit's export, in a folder or as the path of its graph.
    Raises UsageError where there is none, or several; SpecError for a manifest with faults."""
    if (place / MANIFEST_FILE).exists():
        return FoundBundle(place, read_bundle_manifest(place), place / EXAMPLE_FILE)
    if place.is_file() and (place.parent / MANIFEST_FILE).exists():
        raise UsageError(f"{place}: is a file of the bundle {place.parent}: name that")
    exports = [place] if place.is_file() else exports_in(place)
    if len(exports) > 1:
        raise UsageError(
            f"{place}: has several bundles: name one of {', '.join(map(str, exports))}"
        )
    if not exports:
        raise UsageError(
            f"{place}: no bundle: has no {MANIFEST_FILE}, and no graph with a {METADATA} beside it"
        )
    return FoundBundle(
        exports[0].parent, manifest_of_export(exports[0]), exports[0].with_suffix(EXAMPLE)
    )


_GREY = 128


def onnx_policy(place: Path, within_s: float | None = LOADED_WITHIN_S) -> OnnxPolicy:
    """The policy of a bundle. Off the CPU, and where the graph's first axis may be of any length,
    it answers for many episodes at once. Raises as `OnnxPolicy` does."""
    policy = OnnxPolicy(place, within_s)
    return (
        policy
        if policy.graph.on_cpu or not policy.takes_batches
        else OnnxBatchPolicy(place, within_s)
    )


class _Memory:
    """What is kept of one episode."""

    def __init__(self, feeder: Feeder) -> None:
        self.feeder = feeder
        self.last: Command = STILL

    def forget(self) -> None:
        self.feeder.forget()
        self.last = STILL


class OnnxPolicy:
    """A bundle's policy. Raises UsageError or SpecError, before anything is driven, for whatever of
    the bundle is missing or does not fit together; it is asked once, in a grey street, to see that.
    within_s: it is loaded and asked in a child process first, which may take so long
    (`TrialGraph`); None where another process limits this one.

    bundle: its manifest; digest: a hash of that, of the weights, and of what the graph answers in
    that street: its last bits hang on the processor, of which runs that are continued or merged
    must be one kind; example: where its example would be.
    """

    def __init__(self, place: Path, within_s: float | None = LOADED_WITHIN_S) -> None:
        found = read_bundle(place)
        self.bundle = found.manifest
        self.example = found.example
        self.manifest = found.manifest.policy
        self._files = files = bundle_files(found.folder, self.bundle)
        self._within_s = within_s if runs_on_cpu() else None
        self._names = [*dict.fromkeys([*self.bundle.output.outputs, *_state_outputs(self.bundle)])]
        with self.on_trial() as graph:
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
        """Whether the graph can be asked several questions at once, along the first axis of all it
        takes and tells."""
        ports = [*self.graph.inputs.values(), *(self.graph.outputs[name] for name in self._names)]
        layouts = [getattr(one, "layout", "N") for one in self.bundle.inputs.values()]
        return all(port.shape[:1] == (None,) for port in ports) and all(
            layout.startswith("N") for layout in layouts
        )

    def reset(self, episode_id: str, seed: int) -> None:
        """Nothing of the episode before is remembered."""
        self._memory = self._begun(seed)

    def on_reset(self) -> None:
        """What was seen before is no history."""
        self._memory.forget()

    def act(self, observation: Observation) -> PolicyAnswer:
        """Waypoints (N, 2) or (N, 4) in units of the manifest's rule, or a command."""
        return self._answers(self.graph, [self._memory], [observation])[0]

    def on_trial(self) -> AbstractContextManager[Graph | TrialGraph]:
        """The graph where it cannot do harm; in this process where that is limited by others."""
        if self._within_s is None:
            return nullcontext(Graph(self._files.graph))
        return TrialGraph(self._files.graph, self._files.size, self._within_s)

    def _begun(self, seed: int) -> _Memory:
        return _Memory(Feeder(self.bundle.inputs, self.graph.inputs, seed))

    def _answers(
        self, graph: AskedGraph, memories: Sequence[_Memory], seen: Sequence[Observation]
    ) -> list[PolicyAnswer]:
        """To one question; to several where the graph takes them."""
        asked = [memory.feeder.feed(one) for memory, one in zip(memories, seen, strict=True)]
        if len(asked) == 1:
            told = [graph.ask(asked[0], self._names)]
        else:
            whole = {name: np.concatenate([one[name] for one in asked]) for name in asked[0]}
            all_told = graph.ask(whole, self._names)
            told = [
                {name: array[i : i + 1] for name, array in all_told.items()}
                for i in range(len(asked))
            ]
        return [self._answer(*each) for each in zip(memories, seen, told, strict=True)]

    def _answer(
        self, memory: _Memory, seen: Observation, told: Mapping[str, Tensor]
    ) -> PolicyAnswer:
        memory.feeder.remember(told)
        answer = answer_of(self.bundle.output, told, seen.robot, memory.last)
        if isinstance(answer, Command):
            memory.last = answer
        return answer

    def _check(self, graph: AskedGraph) -> None:
        """Raises UsageError unless graph and manifest have the same inputs, and the graph the
        outputs."""
        wanted = graph.inputs
        given = self.bundle.inputs
        if lacking := sorted(wanted.keys() - given.keys()):
            told = "; ".join(f"'{name}' {wanted[name].in_words}" for name in lacking)
            raise UsageError(f"inputs: the graph wants {told}, of which the manifest says nothing")
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

    def _try(self, graph: AskedGraph) -> bytes:
        """Asks once, as a run would, and gives the bytes of what the graph answered. Raises
        UsageError for what the runtime cannot do, and for an answer that is none."""
        seen = in_grey(self.manifest)
        try:
            for _ in range(2):
                answer = self._answers(graph, [self._memory], [seen])[0]
                command_of(answer, rule=self.manifest.waypoints, robot=seen.robot)
            told = graph.ask(self._memory.feeder.feed(seen), self._names)
            return b"".join(told[name].tobytes() for name in self._names)
        except UsageError:
            raise
        except PolicyError as error:
            raise UsageError(
                f"{graph.path}: in a grey street the policy {error}: are its weights whole?"
            ) from error
        except Exception as error:
            raise UsageError(
                f"{graph.path}: cannot be run by onnxruntime: {said_by_runtime(error)}"
            ) from error


class OnnxBatchPolicy(OnnxPolicy):
    """The same for many episodes at once (`cosim.episode.interfaces.BatchPolicy`)."""

    def __init__(self, place: Path, within_s: float | None = LOADED_WITHIN_S) -> None:
        super().__init__(place, within_s)
        self._memories: dict[str, _Memory] = {}

    def reset(self, episode_id: str, seed: int) -> None:
        """Another episode begins."""
        self._memories[episode_id] = self._begun(seed)

    def on_reset(self, episode_id: str = "") -> None:
        """What was seen before in this episode is no history."""
        self._memories[episode_id].forget()

    def ended(self, episode_id: str) -> None:
        """Nothing more is asked about this episode."""
        self._memories.pop(episode_id, None)

    def act(self, observation: Observation) -> PolicyAnswer:
        return self.act_batch([observation])[0]

    def act_batch(self, observations: Sequence[Observation]) -> list[PolicyAnswer]:
        """For each observation what `act` would answer, up to what the processor makes of the last
        bits."""
        return self._answers(
            self.graph, [self._memories[one.episode] for one in observations], observations
        )


def in_grey(manifest: Manifest) -> Observation:
    """What a policy might be given: grey pictures, at rest, the goal 10 m ahead."""

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
        pictures={
            name: CameraPicture(grey(one.size), None, None, calibration_of(one, COURIER))
            for name, one in manifest.cameras.items()
        },
    )


def example_differences(policy: OnnxPolicy) -> dict[str, float]:
    """For each output in the bundle's example the largest difference between what the graph tells
    and what is expected.

    Raises UsageError for a bundle without an example, or with one that does not fit the graph.
    """
    path = policy.example
    try:
        held: dict[str, Tensor] = read_npz(path, most_bytes=MOST_EXAMPLE_BYTES)
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
        with policy.on_trial() as graph:
            told = graph.ask({name: held[name] for name in graph.inputs}, list(graph.outputs))
    except UsageError:
        raise
    except Exception as error:
        raise UsageError(f"{path}: does not fit the graph: {said_by_runtime(error)}") from error
    for name, array in wanted.items():
        if told[name].shape != array.shape:
            raise UsageError(
                f"{path}: expected.{name} is {array.shape}, the graph tells {told[name].shape}"
            )
    return {
        name: float(np.abs(told[name].astype(float) - array).max(initial=0.0))
        for name, array in wanted.items()
    }


def _state_outputs(bundle: BundleManifest) -> list[str]:
    return [one.output for one in bundle.inputs.values() if isinstance(one, StateInput)]
