"""Convert the published file of OpenBot's driving network to an ONNX graph.

python -m cosim.policies.published.openbot autopilot_float.tflite [-o FOLDER]

It needs `pip install -e '.[convert]'`.
"""

from __future__ import annotations

import sys

from cosim.policies.published.openbot.graph import OPENBOT

if __name__ == "__main__":
    OPENBOT.command(sys.argv[1:])
