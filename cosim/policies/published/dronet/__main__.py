"""DroNet as an ONNX graph, made of its published weights, with `pip install onnx h5py`.

python -m cosim.policies.published.dronet model_weights.h5 [-o FOLDER]
"""

from __future__ import annotations

import sys

from cosim.policies.published.dronet.graph import DRONET

if __name__ == "__main__":
    DRONET.command(sys.argv[1:])
