"""The shipped suites as environments of Gymnasium, by id: importing this registers them.

    import cosim.gym
    import gymnasium

    env = gymnasium.make("cosim/Reactive-v1")

The ids are cosim/Unit-v1, cosim/Reactive-v1, cosim/LongHorizon-v1; what else `gymnasium.make` is
given goes to `cosim.make_env`.
"""

from __future__ import annotations

import gymnasium

ENV_IDS = {
    "cosim/Unit-v1": "unit",
    "cosim/Reactive-v1": "reactive",
    "cosim/LongHorizon-v1": "long-horizon",
}
"""The suite of each id."""

for _env_id, _suite in ENV_IDS.items():
    gymnasium.register(_env_id, entry_point="cosim:make_env", kwargs={"suite": _suite})
