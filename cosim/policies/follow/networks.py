"""Networks of `follow`: their files and origin."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Final

import numpy as np

from cosim.core.errors import UsageError
from cosim.policies.onnx.graph import Graph, runtime_message
from cosim.policies.onnx.manifest import FileFacts
from cosim.policies.onnx.weights import NetworkFile, weights_file

ESPNET_WEIGHTS: Final = NetworkFile(
    "espnetv2_s_1.0_city_512x256.pth",
    "sacmehta/EdgeNets, commit 2b232d3f, model/segmentation/model_zoo/espnetv2 (MIT; learned from "
    "Cityscapes, whose pictures are not for commerce)",
    FileFacts(
        bytes=1107690, blake2b="bd8ae334759f256b767d4f930716722fb2a338606ea3f1a9eb19ce1ad7faadcb"
    ),
)
ESPNET_GRAPH: Final = NetworkFile(
    "espnetv2_s_1.0_city_512x256.onnx",
    f"`python -m cosim.policies.follow.espnetv2 {ESPNET_WEIGHTS.name}`, which makes it of that "
    f"file of {ESPNET_WEIGHTS.source}",
    None,
)
YOLOX_NANO: Final = NetworkFile(
    "yolox_nano_coco.onnx",
    "hamacom2004jp/iinfer, commit c7f9a3c5, models (YOLOX-nano of Megvii, Apache-2.0)",
    FileFacts(
        bytes=3713911, blake2b="60348fab3a68aa73d787b06f49371c1f804c151cae846169a6d5f5f56b2c3f42"
    ),
)


class Networks:
    """Both graphs, loaded. Raises UsageError if a file is missing or differs.

    digest: Hash of both files, of their answers on this processor and of the driving rules.
    """

    def __init__(self) -> None:
        digest = hashlib.blake2b()
        for source in sorted(Path(__file__).parent.glob("*.py")):
            digest.update(source.read_bytes())
        graphs = []
        for weights, given, output in (
            (ESPNET_GRAPH, ("picture", (1, 3, 256, 512)), ("scores", (1, 20, 128, 256))),
            (YOLOX_NANO, ("images", (1, 3, 416, 416)), ("output", (1, 3549, 85))),
        ):
            path = _found(weights)
            data = path.read_bytes()
            weights.check(path, data)
            graphs.append(Graph(path))
            digest.update(data + _answer_in_grey(graphs[-1], given, output))
        self.street, self.people = graphs
        self.digest = digest.hexdigest()


def _answer_in_grey(
    graph: Graph, given: tuple[str, tuple[int, ...]], output: tuple[str, tuple[int, ...]]
) -> bytes:
    """Return a graph's output for a grey picture; its last bits depend on the processor.

    Raises UsageError if the graph's input or output differs.
    """
    name, shape = given
    wanted, sides = output
    try:
        answer = graph.run({name: np.full(shape, 0.5, np.float32)}, [wanted])[wanted]
    except Exception as error:
        raise UsageError(
            f"{graph.path}: cannot be run by onnxruntime: {runtime_message(error)}"
        ) from error
    if answer.shape != sides or not np.isfinite(answer).all():
        raise UsageError(
            f"{graph.path}: returns {wanted} {answer.shape}; expected are finite numbers, {sides}"
        )
    return answer.tobytes()


def weights_in_words() -> str:
    """Describe where the weights of both networks are, or which are missing."""
    missing = []
    found = []
    for weights in (ESPNET_GRAPH, YOLOX_NANO):
        try:
            found.append(str(_found(weights)))
        except UsageError:
            missing.append(weights.name)
    return f"weights missing ({', '.join(missing)})" if missing else f"weights {', '.join(found)}"


def _found(weights: NetworkFile) -> Path:
    return weights_file("policy 'follow'", weights.name, weights.facts, weights.source)
