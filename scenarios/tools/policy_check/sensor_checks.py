"""Checks of how a policy uses its lidar and tracked people."""

from __future__ import annotations

from scenarios.tools.policy_check.drives import SCENES
from scenarios.tools.policy_check.edits import NO_RETURNS, sensing
from scenarios.tools.policy_check.outcome import CheckOutcome, doubted, failed, inapplicable, passed
from scenarios.tools.policy_check.query import ROUNDING, Asker, apart


def lidar_ignored(asker: Asker) -> CheckOutcome:
    """Another scan, another answer."""
    if asker.manifest.scan is None:
        return inapplicable("it has no lidar")
    plain = asker.answer("straight", asker.plain)
    others = [
        sensing(scene, asker.drives[scene].seen, "scan") for scene in SCENES if scene != "straight"
    ]
    most = max(
        apart(plain, asker.answer("straight", asker.plain, edit)) for edit in [*others, NO_RETURNS]
    )
    if most <= ROUNDING:
        return failed("no scan changes the answer, not even one without returns")
    return passed(f"another scan changes {100.0 * most:.0f} % of the answer")


def people_ignored(asker: Asker) -> CheckOutcome:
    """A tracked person in the way changes the answer."""
    if asker.manifest.people == "none":
        return inapplicable("it has no tracked people")
    plain = asker.answer("straight", asker.plain)
    met = sensing("person", asker.drives["person"].seen, "people")
    change = apart(plain, asker.answer("straight", asker.plain, met))
    if change <= ROUNDING:
        return doubted(
            "a tracked person 3 m ahead changes nothing: right for a policy that only looks "
            "elsewhere; are x and y exchanged?"
        )
    return passed(f"a tracked person 3 m ahead changes {100.0 * change:.0f} % of the answer")
