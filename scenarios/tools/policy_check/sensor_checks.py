"""Checks of how a policy uses its lidar and tracked people."""

from __future__ import annotations

from scenarios.tools.policy_check.drives import SCENES
from scenarios.tools.policy_check.edits import NO_RETURNS, sensing
from scenarios.tools.policy_check.outcome import CheckOutcome, doubted, failed, inapplicable, passed
from scenarios.tools.policy_check.query import ROUNDING, PolicyQuery, apart


def lidar_ignored(query: PolicyQuery) -> CheckOutcome:
    """Check that another scan changes the answer."""
    if query.manifest.scan is None:
        return inapplicable("it has no lidar")
    plain = query.answer("straight", query.plain)
    others = [
        sensing(scene, query.drives[scene].seen, "scan") for scene in SCENES if scene != "straight"
    ]
    most = max(
        apart(plain, query.answer("straight", query.plain, edit)) for edit in [*others, NO_RETURNS]
    )
    if most <= ROUNDING:
        return failed("no scan changes the answer, not even one without returns")
    return passed(f"another scan changes {100.0 * most:.0f} % of the answer")


def people_ignored(query: PolicyQuery) -> CheckOutcome:
    """Check that a tracked person in the way changes the answer."""
    if query.manifest.people == "none":
        return inapplicable("it has no tracked people")
    plain = query.answer("straight", query.plain)
    met = sensing("person", query.drives["person"].seen, "people")
    change = apart(plain, query.answer("straight", query.plain, met))
    if change <= ROUNDING:
        return doubted(
            "a tracked person 3 m ahead changes nothing: right for a policy that only looks "
            "elsewhere; are x and y exchanged?"
        )
    return passed(f"a tracked person 3 m ahead changes {100.0 * change:.0f} % of the answer")
