"""`orca-hasty`: the oracle whose answers a learner is trained on.

At rest, `orca` waits out of caution for up to three seconds. A learner comes to rest near people
more often than `orca` itself, and answers that tell it to wait there teach it to stay.
"""

from __future__ import annotations

from cosim.policies.privileged.orca import Orca
from cosim.spec.manifest import Manifest


class HastyOrca(Orca):
    """Oracle that at rest moves if a tighter plan can, instead of waiting; privileged."""

    manifest = Manifest("orca-hasty", version="1", rate_hz=5.0, camera=None, privileged=True)
    patient = False
