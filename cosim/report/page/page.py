"""Report page: one HTML file with text, style, scripts, data and pictures; it loads nothing."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any, Final

import jinja2
import msgspec
import numpy as np

from cosim.core.units import duration, milliseconds
from cosim.place.open_ground import GROUND_LOOKS
from cosim.report.page.plots import CAUSE_COLOURS, RUN_COLOURS, Plot
from cosim.report.page.reasons import CAUSES, mishaps_of
from cosim.report.page.runs import ReportedRun, place_in_words
from cosim.report.page.scene import Entry, PlacePicture, Spot
from cosim.report.page.three_tables import BlindRows, summary_table, tables_of, warnings_of
from cosim.results.discerned import is_decoy
from cosim.results.log import holds_waypoints
from cosim.results.run_setup import gait_in_words
from cosim.results.table import injections_in_words, policy_in_words
from cosim.results.throughput import median_answer_ms

_SECURITY_POLICY: Final = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)
"""Content security policy of the page: nothing from outside."""
_MAX_RUNS_NAMED: Final = 4
"""Maximum number of runs named in the heading."""
_MAX_LOST_LISTED: Final = 12
"""Maximum number of crashed and invalid episodes listed per run."""
_FILTERS: Final = {"run": "label", "cause": "cause", "kind": "kind", "place": "place"}
"""Filters above the gallery: name and field of an entry."""


class Maps(msgspec.Struct, frozen=True):
    """Maps of failures.

    pictures: pictures of some places
    spots: failures by place, for all places
    episodes: number of all and of failed episodes by place
    """

    pictures: list[PlacePicture]
    spots: dict[str, list[Spot]]
    episodes: dict[str, tuple[int, int]]


def colours_of(runs: Sequence[ReportedRun]) -> dict[str, str]:
    """Return a colour for each label, the same in all plots."""
    labels = dict.fromkeys(run.label for run in runs)
    return {label: RUN_COLOURS[k % len(RUN_COLOURS)] for k, label in enumerate(labels)}


def render_page(
    runs: Sequence[ReportedRun],
    plots: Sequence[Plot],
    entries: Sequence[Entry],
    maps: Maps,
    note: str,
    blind: BlindRows = MappingProxyType({}),
) -> bytes:
    """Render the HTML file.

    note: what the gallery could not show, "" if nothing.
    blind: results of blind schedules.
    """
    from plotly.offline import get_plotlyjs

    causes = _causes_of(runs)
    data = {
        "plots": [plot.figure for plot in plots],
        "causes": CAUSE_COLOURS,
        "maps": maps,
        "ground": {
            kind: "#{:02x}{:02x}{:02x}".format(*look.drawn) for kind, look in GROUND_LOOKS.items()
        },
    }
    scenes = [
        _json(f"scene-{k}", entry.scene)
        for k, entry in enumerate(entries)
        if entry.scene is not None
    ]
    style, viewer, script = map(_asset, ("page.css", "viewer.html", "page.js"))
    template = _templates().get_template("page.html")
    text = template.render(
        policy=_SECURITY_POLICY,
        labels=list(dict.fromkeys(run.label for run in runs)),
        suites=list(dict.fromkeys(run.spec.suite for run in runs)),
        episodes=sum(len(run.records) for run in runs),
        warnings=warnings_of(runs),
        overview=summary_table(runs, colours_of(runs)),
        tables=tables_of(runs, blind),
        plots=plots,
        gallery=bool(entries or note),
        entries=entries,
        note=note,
        filters=[(name, field, _counts(entries, field)) for name, field in _FILTERS.items()],
        colours=CAUSE_COLOURS,
        maps=maps,
        credits=_credits(maps),
        drawn={picture.place for picture in maps.pictures},
        all_causes=CAUSES,
        causes=causes,
        runs=runs,
        **_what_was_run(runs),
        style=style,
        viewer=viewer,
        library=get_plotlyjs(),
        data=_json("data", data),
        scenes=scenes,
        script=script,
    )
    return text.encode()


@cache
def _templates() -> jinja2.Environment:
    """Return the page's templates, with autoescape."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("cosim.report", "page"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["listed"] = _listed
    return environment


def _asset(name: str) -> str:
    """Return the text of a file in this package."""
    return files("cosim.report.page").joinpath(name).read_text(encoding="utf-8")


def _json(name: str, value: object) -> str:
    """Return a JSON script element; the data cannot close the element."""
    text = msgspec.json.encode(value, enc_hook=np.generic.item).decode()
    safe = text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    return f'<script type="application/json" id="{name}">{safe}</script>\n'


def _listed(words: Sequence[str]) -> str:
    if len(words) > _MAX_RUNS_NAMED:
        words = [*words[: _MAX_RUNS_NAMED - 1], f"{len(words) - _MAX_RUNS_NAMED + 1} more"]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _counts(entries: Sequence[Entry], field: str) -> list[tuple[str, int]]:
    """Return the number of entries by value of a field; causes in their order."""
    counts = Counter(str(getattr(entry, field)) for entry in entries)
    if field == "cause":
        return sorted(
            counts.items(), key=lambda one: CAUSES.index(one[0]) if one[0] in CAUSES else -1
        )
    return list(counts.items())


def _credits(maps: Maps) -> dict[str, list[str]]:
    """Return the places made from map data by the credit their licence requires."""
    places: dict[str, list[str]] = {}
    for picture in maps.pictures:
        if picture.credit:
            places.setdefault(picture.credit.replace("(c)", "©"), []).append(picture.place)
    return places


def _what_was_run(runs: Sequence[ReportedRun]) -> dict[str, Any]:
    """Return the facts needed to repeat the runs: shared ones, differing ones, lost episodes."""
    facts = [_facts(run) for run in runs]
    shared = {
        name: value for name, value in facts[0].items() if all(one[name] == value for one in facts)
    }
    versions = [run.spec.setup.versions for run in runs]
    packages = sorted({name for one in versions for name in one})
    alike = [name for name in packages if len({one.get(name) for one in versions}) == 1]
    if alike:
        shared["versions"] = ", ".join(f"{name} {versions[0][name]}" for name in alike)
    for fact, one in zip(facts, versions, strict=True):
        fact |= {name: one.get(name, "unknown") for name in packages if name not in alike}
    return {
        "shared": shared,
        "differing": {
            name: [one[name] for one in facts] for name in facts[0] if name not in shared
        },
        "without_result": [
            (f"{run.label}, {run.spec.suite}", lines) for run in runs if (lines := _lost(run))
        ],
    }


def _facts(run: ReportedRun) -> dict[str, str]:
    spec = run.spec
    wall_times_s = [record.clock["wall_s"] for record in run.records if "wall_s" in record.clock]
    wall = (
        f"{duration(sum(wall_times_s))} in all, {np.median(wall_times_s):.1f} s the median episode"
        if wall_times_s
        else "unknown"
    )
    took_ms = median_answer_ms(run.records)
    decoys = int(is_decoy(run.table).sum())
    of_these = f", of these {decoys} decoys" if decoys else ""
    has_waypoints = any(map(holds_waypoints, run.path.glob("episodes/*/trajectory.npz")))
    called = policy_in_words(spec.manifest.name, run.records[0].manifest.privileged)
    return {
        "policy": f"{called} {spec.manifest.version} ({spec.policy})",
        "its source": spec.setup.policy_source or "unknown",
        "suite": f"{spec.suite} {spec.suite_version}, {spec.setup.suite_hash}",
        "scenarios": f"{len(spec.scenarios)} scheduled, {len(run.records)} ended{of_these}",
        "metric schema": str(run.table["metric_schema"].iloc[0]),
        "sensor track": run.table["track"].iloc[0],
        "camera": f"{run.table['camera'].iloc[0]}, at {spec.manifest.rate_hz:g} Hz",
        "lidar": run.table["lidar"].iloc[0],
        "inertial sensor": spec.manifest.imu,
        "tracked people": spec.manifest.people,
        "drawn by": spec.setup.renderer,
        "goal": spec.manifest.goal,
        "odometry": spec.manifest.odometry,
        "an answer took": "unknown" if took_ms is None else f"{milliseconds(took_ms)}, the median",
        "latency": "of each answer, measured"
        if spec.setup.real_time
        else f"{spec.setup.latency_ms:g} ms",
        "privileged": "yes: knows what no robot can"
        if run.records[0].manifest.privileged
        else "no",
        "waypoints": spec.manifest.waypoints.in_words
        if has_waypoints
        else "none: it answers with commands",
        "weather": spec.weather or "the scenarios' own",
        "robot": ", ".join(f"{name} ({digest})" for name, digest in spec.robots.items()),
        "gait": gait_in_words(spec.setup.gait, spec.setup.gait_hash)
        if spec.setup.gait
        else "the robot's own",
        "seed of the run": str(spec.setup.seed),
        "injected": injections_in_words(run.table) or "nobody",
        "wall time": wall,
        "folder": str(run.path),
    }


def _lost(run: ReportedRun) -> list[str]:
    """Return a line for each episode that crashed or is invalid."""
    bad = run.table[run.table["status"] != "done"]
    rows = bad[["status", "scenario", "reason"]].itertuples(index=False)
    lines = [f"{status} {name}: {why}" for status, name, why in rows]
    more = [f"and {len(lines) - _MAX_LOST_LISTED} more"] if len(lines) > _MAX_LOST_LISTED else []
    return [*lines[:_MAX_LOST_LISTED], *more]


def _causes_of(runs: Sequence[ReportedRun]) -> Mapping[str, Counter[str]]:
    """Return the number of failures by place and cause."""
    found: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for run in runs:
        for name, record in run.whole.records.items():
            found[place_in_words(run.scenarios[name])].update(
                mishap.cause for mishap in mishaps_of(record)
            )
    return found


def episode_counts(runs: Sequence[ReportedRun]) -> Mapping[str, tuple[int, int]]:
    """Return the number of all and of failed episodes by place, most failures first."""
    total: Counter[str] = Counter()
    failed: Counter[str] = Counter()
    for run in runs:
        for place, status, success in run.table[["place", "status", "success"]].itertuples(
            index=False
        ):
            total[place] += 1
            failed[place] += status == "crashed" or (status == "done" and not success)
    return {
        place: (total[place], failed[place])
        for place, _ in sorted(total.items(), key=lambda i: (-failed[i[0]], i[0]))
    }
