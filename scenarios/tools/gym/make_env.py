"""Make Gymnasium environments of the scenarios of a suite."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from cosim.core.errors import UsageError
from cosim.episode.manifest_checks import check_camera, with_goal
from cosim.spec.manifest import Manifest
from cosim.spec.options import EpisodeOptions
from cosim.spec.robot import robot_called
from cosim.spec.scenario import Split, Suite
from cosim.spec.selection import select_scenarios
from scenarios.suites.catalog import load_suite
from scenarios.tools.gym.reward import Reward, usual_reward

if TYPE_CHECKING:
    from scenarios.tools.gym.environment import SidewalkEnv
    from scenarios.tools.gym.spaces import Actions

LEARNER: Final = Manifest("learner", goal="route_point")
"""Default manifest of a learner: a picture of 96 x 96 pixels four times a second, the next
sub-goal.
"""


def make_env(
    suite: Suite | str,
    manifest: Manifest = LEARNER,
    *,
    scenarios: Sequence[str] = (),
    events: Sequence[str] = (),
    split: Split | None = "val",
    actions: Actions = "command",
    reward: Reward = usual_reward,
    options: EpisodeOptions = EpisodeOptions(),  # noqa: B008  a frozen value
    render_mode: str | None = None,
) -> SidewalkEnv:
    """Make a Gymnasium environment (extra `[gym]`) of the scenarios of a suite.

    suite: a loaded suite, or a name or path as for `load_suite`.
    manifest: observations and their rate, as for any policy, so that the learned policy can run
    with it. See `scenarios.tools.gym.spaces.seen_space` for the names.
    scenarios, events: only these ids, only these kinds of events. Decoys are scenarios like others.
    split: split of the scenarios; None for all, including `test`.
    actions: "command" or "waypoints"; see `scenarios.tools.gym.spaces.action_space_of`.
    reward: reward of a step, a function of a `scenarios.tools.gym.reward.Transition`.
    options: options of the episodes. Without a seed each episode draws its own from that of
    `reset`.

    No engine starts before `reset`.

    Raises UsageError for unknown names and options, for inputs that the robot or Gymnasium lacks,
    and if Gymnasium is not installed.

    >>> blind = Manifest("blind", camera=None, goal="route_point")
    >>> with make_env("unit", blind, scenarios=["straight-001"]) as env:
    ...     seen, info = env.reset(seed=7)
    >>> sorted(seen), info["scenario"]
    (['goal', 'speeds'], 'straight-001')
    """
    try:
        from scenarios.tools.gym.environment import SidewalkEnv
    except ImportError as error:
        remedy = "pip install -e '.[gym]' in the checkout"
        raise UsageError(f"environments need Gymnasium ({error}): {remedy}") from None
    if options.counterfactual:
        raise UsageError(
            "no episode of an environment is compared with its street: leave counterfactual out"
        )
    loaded = load_suite(suite) if isinstance(suite, str) else suite
    selected = select_scenarios(loaded, scenarios, None, events, split)
    picked = [options.apply_to(scenario) for scenario in selected]
    settled = with_goal(manifest, options.goal)
    for name in sorted({scenario.robot for scenario in picked}):
        check_camera(settled, robot_called(name), options.own_camera)
    return SidewalkEnv(picked, settled, actions, reward, options, render_mode, loaded.content_hash)
