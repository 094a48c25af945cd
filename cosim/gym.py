"""Register the shipped suites as Gymnasium environments when imported.

    import cosim.gym
    import gymnasium

    env = gymnasium.make("cosim/Reactive-v2")

The ids are cosim/Unit-v2, cosim/Reactive-v2, cosim/LongHorizon-v2 and cosim/Scans-v1.
`gymnasium.make` passes further arguments to `cosim.make_env`.
"""

from __future__ import annotations

import gymnasium

ENV_IDS = {
    "cosim/Unit-v2": "unit",
    "cosim/Reactive-v2": "reactive",
    "cosim/LongHorizon-v2": "long-horizon",
    "cosim/Scans-v1": "scans",
}
"""Suite name by environment id."""

for _env_id, _suite in ENV_IDS.items():
    gymnasium.register(_env_id, entry_point="cosim:make_env", kwargs={"suite": _suite})
