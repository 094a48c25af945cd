"""What `cosim run --on` does in place of starting processes on this machine."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from cosim.cli.terminal.consoles import err
from cosim.core.errors import UsageError

if TYPE_CHECKING:
    from cosim.cli.runs.run import ReachesWorkers
    from cosim.records.run_folder import RunFolder
    from cosim.spec.scenario import Scenario
    from scenarios.execution.asked import Patience
    from scenarios.execution.messages import Hear, Hello
    from scenarios.execution.transport import Transport

_ALONE = ("shared_renderer", "real_time", "live", "rerun")


def check_on(on: str, asked: Mapping[str, Any]) -> None:
    """Raises UsageError without Ray, for what is no cluster's name, and for options of local processes."""
    from scenarios.many.on_ray import check_ray

    check_ray(on)
    for name in _ALONE:
        if asked[name]:
            raise UsageError(f"--{name.replace('_', '-')} is of processes of this machine: leave it, or --on, out")


@contextmanager
def carried_by_ray(on: str, jobs: int | None, policy: str) -> Iterator[ReachesWorkers]:
    """A connection to a Ray cluster, and how its workers are reached."""
    from scenarios.many.on_ray import RayWorkers, ray_cluster

    with ray_cluster(on, policy, _say):

        @contextmanager
        def reached(
            held: RunFolder, todo: Sequence[Scenario], picked: Sequence[Scenario], hello: Hello, patience: Patience,
            tell: Hear,
        ) -> Iterator[tuple[Transport, Hear]]:  # fmt: skip
            workers = RayWorkers(held.spec, held.path / "logs", jobs, len(todo), _say)
            _say(f"{workers.wanted} workers on Ray")
            yield workers, tell

        yield reached


def _say(words: str) -> None:
    err.print(words, soft_wrap=True, highlight=False, markup=False)
