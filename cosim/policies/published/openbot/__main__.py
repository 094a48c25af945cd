"""OpenBot's driving network as an ONNX graph, made of the file that is published, with `pip install
onnx flatbuffers`.

python -m cosim.policies.published.openbot autopilot_float.tflite [-o FOLDER]
"""

from __future__ import annotations

import sys

from cosim.policies.published.openbot.graph import OPENBOT

if __name__ == "__main__":
    OPENBOT.command(sys.argv[1:])
