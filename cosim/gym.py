"""Register the shipped suites as Gymnasium environments when imported.

    import cosim.gym
    import gymnasium

    env = gymnasium.make("cosim/Reactive-v1")

The ids are cosim/Unit-v1, cosim/Reactive-v1 and cosim/LongHorizon-v1. `gymnasium.make` passes
further arguments to `cosim.make_env`.
"""

from __future__ import annotations

import gymnasium

ENV_IDS = {
    "cosim/Unit-v1": "unit",
    "cosim/Reactive-v1": "reactive",
    "cosim/LongHorizon-v1": "long-horizon",
}
"""Suite name by environment id."""

for _env_id, _suite in ENV_IDS.items():
    gymnasium.register(_env_id, entry_point="cosim:make_env", kwargs={"suite": _suite})
