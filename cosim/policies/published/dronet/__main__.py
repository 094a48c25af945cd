"""Convert the published weights of DroNet to an ONNX graph.

python -m cosim.policies.published.dronet model_weights.h5 [-o FOLDER]

It needs `pip install -e '.[convert]'`.
"""

from __future__ import annotations

import sys

from cosim.policies.published.dronet.graph import DRONET

if __name__ == "__main__":
    DRONET.command(sys.argv[1:])
