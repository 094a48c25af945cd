"""The report as one HTML file: text, style, scripts, data and pictures in it; it asks nobody for
anything."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Final

import msgspec
import numpy as np

from cosim.core.telling import duration, milliseconds
from cosim.place.open_ground import GROUND_LOOKS
from cosim.report.page.plots import CAUSE_COLOURS, RUN_COLOURS, Plot
from cosim.report.page.reasons import CAUSES, mishaps_of
from cosim.report.page.runs import ReportedRun, place_in_words
from cosim.report.page.scene import Entry, PlacePicture, Spot
from cosim.report.page.three_tables import summary_html, tables_html, warnings_html, wide_html
from cosim.results.log import holds_waypoints
from cosim.results.table import injections_in_words, policy_in_words
from cosim.results.throughput import median_answer_ms

_POLICY: Final = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)
"""What the page may load: nothing from outside."""
_MOST_LISTED: Final = 4
"""Of more runs than this the heading names fewer."""
_MOST_TOLD: Final = 12
"""Of crashed and invalid episodes of a run so many are told by name."""


class Maps(msgspec.Struct, frozen=True):
    """Where things went wrong. pictures: of some places; spots: of all, by place; episodes: of each
    place, all and failed."""

    pictures: list[PlacePicture]
    spots: dict[str, list[Spot]]
    episodes: dict[str, tuple[int, int]]


def colours_of(runs: Sequence[ReportedRun]) -> dict[str, str]:
    """A colour for each label, the same in all plots."""
    labels = dict.fromkeys(run.label for run in runs)
    return {label: RUN_COLOURS[k % len(RUN_COLOURS)] for k, label in enumerate(labels)}


def page_of(
    runs: Sequence[ReportedRun],
    plots: Sequence[Plot],
    entries: Sequence[Entry],
    maps: Maps,
    note: str,
) -> bytes:
    """The file. note: what the gallery could not show, "" if nothing."""
    from plotly.offline import get_plotlyjs

    labels = list(dict.fromkeys(run.label for run in runs))
    title = f"{' · '.join(labels)}: cosim report"
    sections = {
        "results": (
            "Results",
            f"{warnings_html(runs)}{summary_html(runs, colours_of(runs))}{tables_html(runs)}",
        ),
        "plots": (
            "Where it goes wrong",
            f'<div class="plots">{"".join(map(_plot, range(len(plots)), plots))}</div>',
        ),
        "failures": ("Failures", _gallery(entries, note)),
        "places": ("Places", _places(maps, _causes_of(runs))),
        "runs": ("What was run", _what_was_run(runs)),
    }
    if not entries and not note:
        del sections["failures"]
    if not maps.spots:
        del sections["places"]
    if not plots:
        del sections["plots"]
    nav = "".join(f'<a href="#{name}">{words}</a>' for name, (words, _) in sections.items())
    body = "".join(
        f'<section id="{name}"><h2>{words}</h2>{inner}</section>'
        for name, (words, inner) in sections.items()
    )
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
    assets = files("cosim.report.page")
    style, viewer, script = (
        (assets / name).read_text(encoding="utf-8")
        for name in ("page.css", "viewer.html", "page.js")
    )
    text = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        f'<meta name="viewport" content="width=device-width, '
        f'initial-scale=1"><title>{escape(title)}</title>'
        f"<style>{style}</style></head><body>"
        f'<header><p class="mark">cosim report</p><h1>{_lede(runs)}</h1></header><nav '
        f'aria-label="Parts">{nav}</nav>'
        f"<main>{body}</main>{viewer}"
        f"<script>{get_plotlyjs()}</script>{_json('data', data)}{''.join(scenes)}<script>{script}</script>"
        "</body></html>\n"
    )
    return text.encode()


def _json(name: str, value: object) -> str:
    """Data in the page: nothing in it can end the element that it stands in."""
    text = msgspec.json.encode(value, enc_hook=np.generic.item).decode()
    safe = text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    return f'<script type="application/json" id="{name}">{safe}</script>\n'


def _lede(runs: Sequence[ReportedRun]) -> str:
    labels = [escape(label) for label in dict.fromkeys(run.label for run in runs)]
    suites = [escape(name) for name in dict.fromkeys(run.spec.suite for run in runs)]
    episodes = sum(len(run.records) for run in runs)
    return f"{_listed(labels)} on {_listed(suites)}: {episodes:,} episode{'s' * (episodes != 1)}"


def _listed(words: Sequence[str]) -> str:
    if len(words) > _MOST_LISTED:
        words = [*words[: _MOST_LISTED - 1], f"{len(words) - _MOST_LISTED + 1} more"]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _plot(number: int, plot: Plot) -> str:
    return (
        "<figure "
        f'class="plot"><figcaption><h3>{escape(plot.title)}</h3><p>{escape(plot.note)}</p></figcaption><div class="drawing" data-plot="{number}" style="min-height:{plot.figure["layout"]["height"]}px" role="img" aria-label="{escape(plot.title)}"></div></figure>'
    )


def _gallery(entries: Sequence[Entry], note: str) -> str:
    fields = {"run": "label", "cause": "cause", "kind": "kind", "place": "place"}
    choices = []
    for name, field in fields.items():
        counts = Counter(str(getattr(entry, field)) for entry in entries)
        values = (
            sorted(counts, key=lambda v: CAUSES.index(v) if v in CAUSES else -1)
            if field == "cause"
            else [*counts]
        )
        options = "".join(
            f'<option value="{escape(v)}">{escape(v)} ({counts[v]})</option>' for v in values
        )
        choices.append(
            f'<label>{name}<select data-field="{field}"><option '
            f'value="">all</option>{options}</select></label>'
        )
    cards = "".join(_card(number, entry) for number, entry in enumerate(entries))
    intro = (
        f"{len(entries)} failures, chosen so that every run, structure, event and cause is there, "
        "and every real place that was driven, as far as there is room; of a long episode its "
        "first failure, and others that come soon. Open one to see its last seconds again: from "
        "above, by the robot's camera, from behind."
    )
    said = f'<p class="warn">{escape(note)}</p>' if note else ""
    return (
        f'<p class="intro">{intro}</p>{said}<div class="filters">{"".join(choices)}<output '
        f'id="shown"></output></div><ol class="cards">{cards}</ol>'
    )


def _card(number: int, entry: Entry) -> str:
    facts = " · ".join(
        escape(part)
        for part in dict.fromkeys((entry.label, entry.event or entry.kind, entry.place))
    )
    about = (
        f'<span class="cause" style="--c:{CAUSE_COLOURS[entry.cause]}">{escape(entry.cause)}</span>'
        f"<b>{escape(entry.reason[:1].upper() + entry.reason[1:])}.</b>"
        f"<small>{facts}<br>{escape(entry.scenario)}, {entry.at_s:.1f} s</small>"
    )
    attributes = "".join(
        f' data-{name}="{escape(str(getattr(entry, name)))}"'
        for name in ("label", "cause", "kind", "place")
    )
    if entry.scene is None:
        return (
            f'<li{attributes}><div class="card '
            f'bare">{about}<small>{escape(entry.why)}</small></div></li>'
        )
    shot = entry.scene.pictures.follow[-1] if entry.scene.pictures.follow else ""
    picture = f'<img src="{shot}" alt="" width="384" height="216" decoding="async">' if shot else ""
    return (
        f'<li{attributes}><button class="card" type="button" '
        f'data-entry="{number}">{picture}{about}</button></li>'
    )


def _places(maps: Maps, causes: Mapping[str, Counter[str]]) -> str:
    drawn = {picture.place for picture in maps.pictures}
    options = "".join(
        f'<option value="{k}">{escape(p.place)}: {causes[p.place].total()} failures</option>'
        for k, p in enumerate(maps.pictures)
    )
    drawing = '<div id="map" class="drawing" role="img" aria-label="Failures on the map"></div>'
    chooser = (
        f'<div class="filters"><label>place<select id="place">{options}</select></label></div>'
        f'<figure class="plot"><h3 id="map-name"></h3>{drawing}</figure>'
        if options
        else ""
    )
    rows = []
    for place, (episodes, failed) in maps.episodes.items():
        told = ", ".join(
            f"{cause} {causes[place][cause]}" for cause in CAUSES if causes[place][cause]
        )
        mark = "" if place in drawn else ' class="quiet"'
        rows.append(
            f'<tr{mark}><th scope="row">{escape(place)}</th><td>{episodes}</td><td>{failed}</td>'
            f'<td class="word">{escape(told)}</td></tr>'
        )
    heads = '<th scope="col">place</th><th scope="col">episodes</th><th scope="col">failed</th>'
    heads += '<th scope="col" class="word">what went wrong</th>'
    listed = wide_html("Every place", f"<tr>{heads}</tr>", rows)
    return (
        f'<p class="intro">Dots are failures; the large ones open.</p>{chooser}{_credits(maps)}'
        f"<details><summary>Every place ({len(maps.episodes)})</summary>{listed}</details>"
    )


def _credits(maps: Maps) -> str:
    """Credit the data of places that were made from maps."""
    of: dict[str, list[str]] = {}
    for picture in maps.pictures:
        if picture.credit:
            of.setdefault(picture.credit.replace("(c)", "©"), []).append(picture.place)
    return "".join(
        f'<p class="intro">Map data of {escape(", ".join(names))}: {escape(credit)}.</p>'
        for credit, names in of.items()
    )


def _what_was_run(runs: Sequence[ReportedRun]) -> str:
    """What each run was, so that somebody else can do it again: what they share once, the rest side
    by side."""
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
        fact |= {name: one.get(name, "not told") for name in packages if name not in alike}
    parts = [_listing(shared)] if shared else []
    if differing := [name for name in facts[0] if name not in shared]:
        heads = "".join(
            f'<th scope="col">{escape(run.label)}, {escape(run.spec.suite)}</th>' for run in runs
        )
        rows = [
            f'<tr><th scope="row">{name}</th>{"".join(f"<td>{escape(one[name])}</td>" for one in facts)}</tr>'
            for name in differing
        ]
        parts.append(wide_html("What differs", f"<tr><td></td>{heads}</tr>", rows, "facts"))
    return "".join([*parts, *(_lost(run) for run in runs)])


def _listing(facts: Mapping[str, str]) -> str:
    items = "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts.items()
    )
    return f'<div class="run"><dl>{items}</dl></div>'


def _facts(run: ReportedRun) -> dict[str, str]:
    spec = run.spec
    walls = [record.clock["wall_s"] for record in run.records if "wall_s" in record.clock]
    wall = (
        f"{duration(sum(walls))} in all, {np.median(walls):.1f} s the median episode"
        if walls
        else "not told"
    )
    took_ms = median_answer_ms(run.records)
    follows = any(map(holds_waypoints, run.path.glob("episodes/*/trajectory.npz")))
    called = policy_in_words(spec.manifest.name, run.records[0].manifest.privileged)
    return {
        "policy": f"{called} {spec.manifest.version} ({spec.policy})",
        "its source": spec.setup.policy_source or "not told",
        "suite": f"{spec.suite} {spec.suite_version}, {spec.setup.suite_hash}",
        "scenarios": f"{len(spec.scenarios)} scheduled, {len(run.records)} ended",
        "metric schema": str(run.table["metric_schema"].iloc[0]),
        "camera": f"{run.table['camera'].iloc[0]}, at {spec.manifest.rate_hz:g} Hz",
        "drawn by": spec.setup.renderer,
        "goal": spec.manifest.goal,
        "odometry": spec.manifest.odometry,
        "an answer took": "not told" if took_ms is None else f"{milliseconds(took_ms)}, the median",
        "latency": "of each answer, measured"
        if spec.setup.real_time
        else f"{spec.setup.latency_ms:g} ms",
        "privileged": "yes: knows what no robot can"
        if run.records[0].manifest.privileged
        else "no",
        "waypoints": spec.manifest.waypoints.in_words
        if follows
        else "none: it answers with commands",
        "robot": ", ".join(f"{name} ({digest})" for name, digest in spec.robots.items()),
        "seed of the run": str(spec.setup.seed),
        "injected": injections_in_words(run.table) or "nobody",
        "wall time": wall,
        "folder": str(run.path),
    }


def _lost(run: ReportedRun) -> str:
    """The episodes that crashed or are invalid, and why."""
    bad = run.table[run.table["status"] != "done"]
    told = [
        f"{status} {name}: {why}"
        for status, name, why in bad[["status", "scenario", "reason"]].itertuples(index=False)
    ]
    if not told:
        return ""
    more = [f"and {len(told) - _MOST_TOLD} more"] if len(told) > _MOST_TOLD else []
    lines = "".join(f"<li>{escape(line)}</li>" for line in [*told[:_MOST_TOLD], *more])
    title = f"{escape(run.label)}, {escape(run.spec.suite)}: without a result"
    return f'<div class="run"><h3>{title}</h3><ul>{lines}</ul></div>'


def _causes_of(runs: Sequence[ReportedRun]) -> Mapping[str, Counter[str]]:
    """How often each cause was, by place: of all failures, also of those that no map has room
    for."""
    found: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for run in runs:
        for name, record in run.whole.records.items():
            found[place_in_words(run.scenarios[name])].update(
                mishap.cause for mishap in mishaps_of(record)
            )
    return found


def counts_of(runs: Sequence[ReportedRun]) -> Mapping[str, tuple[int, int]]:
    """Episodes and failed episodes of each place, the most failures first."""
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
