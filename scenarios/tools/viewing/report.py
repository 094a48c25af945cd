"""Write the report of runs as one HTML file. Failures are replayed in worker processes."""

from __future__ import annotations

import os
from collections.abc import MutableSequence, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import msgspec
import numpy as np
import shapely

from cosim.core.child_process import exit_with_parent
from cosim.core.clock import Clock
from cosim.core.errors import CosimError, unwritable
from cosim.core.files import write_atomic
from cosim.core.progress import Progress, ignore
from cosim.report.above import ROUTE, Sheet, draw_streets
from cosim.report.encoding import image_url
from cosim.report.page.choice import (
    MAX_FAILURES,
    WITHIN_S,
    FailureToShow,
    choose_failures,
    showable_failures,
)
from cosim.report.page.page import Maps, colours_of, episode_counts, render_page
from cosim.report.page.plots import plots_of
from cosim.report.page.reasons import Mishap, mishaps_of, reason_of
from cosim.report.page.runs import (
    ReportedRun,
    light_in_words,
    place_in_words,
    read_runs,
    scenario_kind,
)
from cosim.report.page.scene import Entry, PlacePicture, Spot
from cosim.results.intervals import Estimate
from cosim.spec.run_config import CameraChoice
from cosim.spec.scenario import CityMap, Place, Scenario
from scenarios.places.nets import place
from scenarios.suites.exploits import exploit_of
from scenarios.tools.viewing.scenes import ShownAgain, show_again, ticks_to_show
from sumo_nets.maps.map_store import credit_of

_MAX_BYTES: Final = 29_000_000
"""Largest size of the file, in bytes. The least informative failures beyond it are left out."""
_REST_BYTES: Final = 8_000_000
"""Bytes reserved for everything but failures and maps: Plotly, tables, small pictures and spots."""
_MAX_MAPS: Final = 24
_MAP_PX: Final = 1000
_MAP_QUALITY: Final = 70
_MARGIN_M: Final = 25.0
_MAX_SPOTS: Final = 300
"""Largest number of spots on the map of a place."""
_TELL_EVERY_S: Final = 0.2
_T = TypeVar("_T")
_Bounds = tuple[float, float, float, float]


class ReportFacts(NamedTuple):
    """Facts about a report.

    size_bytes: size of the file.
    shown: failures in its gallery.
    failures: all failures.
    limit: the limit that excluded the others, "" if all are shown.
    """

    size_bytes: int
    shown: int
    failures: int
    limit: str


def make_report(
    folders: Sequence[Path],
    output: Path,
    *,
    camera: CameraChoice = "auto",
    jobs: int = 2,
    most: int = MAX_FAILURES,
    within_s: float = WITHIN_S,
    progress: Progress = ignore,
) -> ReportFacts:
    """Write the report of these run folders. most: failures in its gallery; within_s: later
    failures of an episode are left out where an earlier one is shown.

    Raises what `read_runs` raises, and MachineError when it cannot be written; then nothing is.
    """
    runs = read_runs(folders, progress)
    plots = plots_of(runs, colours_of(runs), progress)
    candidates = showable_failures(runs)
    picks, limit = choose_failures(candidates, most, within_s)
    progress("starting the engines")
    episodes, lost = _episodes(runs, picks)
    context = get_context("spawn")
    done = context.Array("d", max(len(episodes), 1), lock=False)
    with ProcessPoolExecutor(
        jobs, context, initializer=_begin, initargs=(os.getpid(), done)
    ) as pool:
        try:
            again = [
                pool.submit(_shown_again, k, runs[one.run].path, one.scenario, one.mishaps, camera)
                for k, one in enumerate(episodes)
            ]
            drawn = _begun_pictures(pool, runs)
            _wait([*again, *drawn], [one.ticks for one in episodes], done, progress)
            pictures = [came for came in map(_outcome, drawn) if not isinstance(came, str)]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    showings = lost | _showings(episodes, again)
    entries = [_entry(runs[pick.run], pick, showings[k]) for k, pick in enumerate(picks)]
    progress("writing the page")
    fixed = len(msgspec.json.encode(pictures)) + _REST_BYTES
    sizes = np.array([len(msgspec.json.encode(entry)) for entry in entries], dtype=int)
    count = int((fixed + np.cumsum(sizes) <= _MAX_BYTES).sum())
    maps = Maps(pictures, _spots(runs, picks[:count]), dict(episode_counts(runs)))
    data = render_page(runs, plots, entries[:count], maps, _note(entries[:count]), blind_rows(runs))
    try:
        write_atomic(output, data)
    except OSError as error:
        raise unwritable(output, error) from error
    if count < len(picks):
        limit = f"the file would be larger than {_MAX_BYTES / 1e6:g} MB"
    return ReportFacts(len(data), count, len(candidates), limit)


def blind_rows(runs: Sequence[ReportedRun]) -> dict[str, dict[str, Estimate]]:
    """Return the success of the best blind schedules found, by suite of the runs and kind."""
    found = {}
    for run in runs:
        exploit = exploit_of(run.spec.setup.suite_hash, run.spec.robots)
        if exploit is not None:
            found[run.spec.suite] = {kind: share.estimate for kind, share in exploit.row().items()}
    return found


class _Episode(NamedTuple):
    """Episode that is replayed. picks: numbers of its failures; mishaps: these failures."""

    run: int
    scenario: str
    picks: list[int]
    mishaps: list[Mishap]

    @property
    def ticks(self) -> int:
        """Return the duration of showing its failures, in ticks."""
        return ticks_to_show(self.mishaps)


def _episodes(
    runs: Sequence[ReportedRun], picks: Sequence[FailureToShow]
) -> tuple[list[_Episode], dict[int, str]]:
    """Return the episodes of the picks, longest first, and the reasons for picks without one."""
    numbers: dict[tuple[int, str], list[int]] = {}
    lost: dict[int, str] = {}
    for k, pick in enumerate(picks):
        numbers.setdefault((pick.run, pick.scenario), []).append(k)
    found = []
    for (run, scenario), of_it in numbers.items():
        if runs[run].log(scenario) is None:
            lost |= dict.fromkeys(of_it, "its trajectory is no longer in the run folder")
        else:
            found.append(_Episode(run, scenario, of_it, [picks[k].mishap for k in of_it]))
    return sorted(found, key=lambda one: -one.ticks), lost


_done: MutableSequence[float] = []
"""Progress of each episode, shared between a worker process and the waiting process."""


def _begin(parent: int, done: MutableSequence[float]) -> None:
    """Initialize a process that replays failures."""
    global _done
    exit_with_parent(parent)
    _done = done


def _shown_again(
    number: int, folder: Path, scenario_id: str, mishaps: Sequence[Mishap], camera: CameraChoice
) -> list[ShownAgain]:
    """Show failures of an episode, in a worker process. number: of the episode among those
    shown.
    """

    def took(ticks: int) -> None:
        _done[number] = ticks

    return show_again(folder, scenario_id, mishaps, camera, took)


def _wait(
    futures: Sequence[Future[Any]], ticks: Sequence[int], done: Sequence[float], progress: Progress
) -> None:
    """Wait for all futures. The first ones are episodes.

    ticks: duration of each episode.
    done: number of finished ticks of each.
    """
    left: set[Future[Any]] = set(futures)
    while left:
        left = wait(left, _TELL_EVERY_S, FIRST_COMPLETED).not_done
        came = [
            all_of if future.done() else now
            for future, all_of, now in zip(futures, ticks, done, strict=False)
        ]
        share = min(sum(came) / max(sum(ticks), 1), 0.99)
        progress("showing failures again" if ticks else "drawing maps", share if ticks else None)


def _showings(
    episodes: Sequence[_Episode], again: Sequence[Future[list[ShownAgain]]]
) -> dict[int, ShownAgain | str]:
    """Return the result of every pick, by its number: the replayed failure, or why it is
    missing.
    """
    found: dict[int, ShownAgain | str] = {}
    for one, future in zip(episodes, again, strict=True):
        came = _outcome(future)
        for place_of, k in enumerate(one.picks):
            found[k] = came if isinstance(came, str) else came[place_of]
    return found


def _outcome(future: Future[_T]) -> _T | str:
    """Return the result of a process, or its error message."""
    try:
        return future.result()
    except CosimError as error:
        return str(error)
    except BrokenProcessPool:
        return "the process that ran it again died"


def _entry(run: ReportedRun, pick: FailureToShow, showing: ShownAgain | str) -> Entry:
    scenario = run.scenarios[pick.scenario]
    record = run.whole.records[pick.scenario]
    other = None if isinstance(showing, str) else showing.other
    return Entry(
        label=run.label,
        suite=run.spec.suite,
        scenario=pick.scenario,
        kind=scenario_kind(scenario),
        event=pick.event,
        place=pick.place,
        light=light_in_words(scenario),
        cause=pick.mishap.cause,
        reason=reason_of(scenario, record, pick.mishap, run.log(pick.scenario), other),
        at_s=Clock().time_s(pick.mishap.tick + 1),
        scene=None if isinstance(showing, str) else showing.scene,
        why=showing if isinstance(showing, str) else "",
    )


def _note(entries: Sequence[Entry]) -> str:
    """Describe how many failures could not be replayed, and why the first could not."""
    lost = [entry for entry in entries if entry.scene is None]
    if not lost:
        return ""
    return (
        f"{len(lost)} of {len(entries)} failures could not be shown again. {lost[0].scenario}: "
        f"{lost[0].why}"
    )


def _begun_pictures(
    pool: ProcessPoolExecutor, runs: Sequence[ReportedRun]
) -> list[Future[PlacePicture]]:
    """Start pictures from above: of every real place with failures, then of those with the most."""
    there: dict[str, list[Scenario]] = {}
    for run in runs:
        for record in run.records:
            scenario = run.scenarios[record.scenario.id]
            there.setdefault(place_in_words(scenario), []).append(scenario)
    failed = [name for name, (_, bad) in episode_counts(runs).items() if bad]
    failed.sort(key=lambda name: not isinstance(there[name][0].place, CityMap))
    return [
        pool.submit(
            _place_picture,
            name,
            there[name][0].place,
            _bounds(there[name]),
            [s.route for s in there[name]],
        )
        for name in failed[:_MAX_MAPS]
    ]


def _bounds(scenarios: Sequence[Scenario]) -> _Bounds:
    """Return bounds around the routes, in metres, with an aspect of at most 5 to 2."""
    route = np.concatenate([np.array(scenario.route) for scenario in scenarios])
    low = route.min(axis=0) - _MARGIN_M
    high = route.max(axis=0) + _MARGIN_M
    room = np.maximum(0.4 * (high - low).max() - (high - low), 0.0) / 2.0
    (x0, y0) = (low - room).tolist()
    (x1, y1) = (high + room).tolist()
    return x0, y0, x1, y1


def _place_picture(
    name: str, where: Place, bounds: _Bounds, routes: Sequence[tuple[tuple[float, float], ...]]
) -> PlacePicture:
    """Draw the picture of a place, in a worker process."""
    _, street_map = place(where)
    x0, y0, x1, y1 = bounds
    sheet = Sheet(bounds, _MAP_PX / max(x1 - x0, y1 - y0))
    draw_streets(sheet, street_map, shapely.box(*bounds))
    for route in dict.fromkeys(routes):
        sheet.line(np.array(route), ROUTE, max(0.4, 2.0 / sheet.px_per_m))
    return PlacePicture(
        place=name,
        image=image_url(sheet.image, _MAP_QUALITY),
        bounds=bounds,
        credit=credit_of(where),
    )


def _spots(runs: Sequence[ReportedRun], picks: Sequence[FailureToShow]) -> dict[str, list[Spot]]:
    """Return the places of all failures, by map."""
    numbers = {(pick.run, pick.scenario, pick.mishap): k for k, pick in enumerate(picks)}
    spots: dict[str, list[Spot]] = {}
    for number, run in enumerate(runs):
        for record in run.records:
            scenario = run.scenarios[record.scenario.id]
            for mishap in mishaps_of(record):
                x_m, y_m = (
                    (mishap.failure.x_m, mishap.failure.y_m)
                    if mishap.failure
                    else scenario.start[:2]
                )
                if (
                    mishap.failure is None
                    and (log := run.log(record.scenario.id)) is not None
                    and len(log)
                ):
                    x_m, y_m = log.pose[-1, :2].tolist()
                reason = reason_of(scenario, record, mishap, None)
                words = (
                    f"{record.scenario.id} ({run.label}), {Clock().time_s(mishap.tick + 1):.1f} "
                    f"s: {reason}"
                )
                entry = numbers.get((number, record.scenario.id, mishap), -1)
                spot = Spot(
                    x_m=round(x_m, 2),
                    y_m=round(y_m, 2),
                    cause=mishap.cause,
                    words=words,
                    entry=entry,
                )
                spots.setdefault(place_in_words(scenario), []).append(spot)
    return {
        name: sorted(there, key=lambda spot: spot.entry < 0)[:_MAX_SPOTS]
        for name, there in spots.items()
    }
