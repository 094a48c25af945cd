"""The page of `cosim report` in a browser: it opens from disk, plays failures, and fits desktop,
phone and paper."""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cosim.cli import progress
from cosim.report.page.page import Maps, colours_of, episode_counts, render_page
from cosim.report.page.plots import plots_of
from cosim.report.page.reasons import CAUSES
from cosim.report.page.runs import read_runs
from cosim.report.page.scene import PlacePicture, Spot
from cosim.spec.scenario import City, Suite, write_suite
from tests.conftest import Cosim
from tests.support.blind_policy import BEND
from tests.support.chromium import CHROMIUM, Page, chromium
from tests.support.driven_runs import HIT, run_of, short_way
from tests.support.event_ways import event_way

pytestmark = [
    pytest.mark.engine,
    pytest.mark.skipif(CHROMIUM is None and "CI" not in os.environ, reason="no Chromium here"),
]
PICTURED = (
    "document.querySelector('#by-robot').naturalWidth > 0 && "
    "document.querySelector('#from-behind').naturalWidth > 0"
)
DRAWN = "document.querySelector('#above').toDataURL()"
WIDE = "document.documentElement.scrollWidth"
PIXEL = "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7"
CUT_OFF = """[...document.querySelectorAll('.drawing')].flatMap((plot) => {
  const box = (one) => one.getBoundingClientRect(), all = box(plot);
  const within = ({ left, right, top, bottom }) => left > all.left - 1 && right < all.right + 1
    && top > all.top - 1 && bottom < all.bottom + 1;
  const wide = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left);
  const high = (a, b) => Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
  const texts = [...plot.querySelectorAll('.main-svg text')].filter((t) => t.textContent.trim() && box(t).width);
  const still = texts.filter((t) => !t.closest('.hoverlayer'));
  const covers = (a, b) => wide(box(a), box(b)) > 2 && high(box(a), box(b)) > 3;
  const covered = still.filter((a, k) => still.slice(0, k).some((b) => covers(a, b)));
  return [...texts.filter((t) => !within(box(t))), ...covered].map((t) => t.textContent);
})"""
"""Script that lists texts of plots that leave their plot or overlap another."""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory, cosim: Cosim) -> Path:
    """The report of a run of two scenarios that a blind policy fails, written over an existing
    file."""
    folder = tmp_path_factory.mktemp("report")
    ways = (event_way("lateral", "a", at_m=8.0), event_way("obstructing", "b", at_m=11.0))
    write_suite(Suite(name="ways", version="1", scenarios=ways), folder / "ways.json")
    words = ("--policy", "tests.support.blind_policy:Blind", "--out", "run")
    done = cosim("run", "ways.json", *words, cwd=folder)
    assert done.returncode == 0, done.stderr
    (folder / "report.html").write_text("another page")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(progress, "REPEAT_S", 0.0)
        done = cosim("report", "run", "--jobs", "1", "-o", "report.html", cwd=folder)
    assert done.returncode == 0, done.stderr
    shares = [int(share) for share in re.findall(r"showing failures again: (\d+) %", done.stderr)]
    assert len(shares) > 2 and shares == sorted(shares) and shares[-1] > 50, done.stderr
    assert "2 of 2 failures), in place of the one that was there" in done.stdout
    return folder / "report.html"


@pytest.fixture(scope="module")
def browser() -> Iterator[Page]:
    with chromium() as page:
        yield page


@pytest.fixture
def page(report: Path, browser: Page) -> Iterator[Page]:
    """The report, opened on a desktop; at the end it has logged no error and sent no request."""
    browser.size(1280, 900)
    browser.open(report)
    yield browser
    assert browser.wrong == []
    assert browser.asked == []


def test_plans_are_drawn_on_the_map_and_in_the_picture(page: Page) -> None:
    """A command, then from 1 s on waypoints with the third followed, appear in both pictures and
    the legend."""
    drawn = (
        "[...document.querySelectorAll('#way circle')].map((c) => [c.cx.baseVal.value, "
        "c.cy.baseVal.value])"
    )
    scenes = [
        page.js(f"JSON.parse(document.querySelector('#scene-{k}').textContent)") for k in range(2)
    ]
    for number, scene in enumerate(scenes):
        page.js(f"document.querySelector('[data-entry=\"{number}\"]').click()")
        page.until(PICTURED)
        last = scene["plans"][-1][1]
        legend = page.js("document.querySelector('#key-way').textContent")
        touched = np.array(last[:2])
        points = np.array(last).reshape(-1, 2)[1:]
        begun = scene["plans"][0][0] > 0
        assert legend.startswith("what was commanded" if begun else "planned waypoints")
        assert (
            np.allclose(np.hypot(*(points - touched).T), 100.0 * np.hypot(*BEND.T), atol=1.0)
            and scene["follows"] == 3
        )
        page.key("End", code=35)
        assert page.js("document.querySelector('#key-way').textContent").startswith(
            "planned waypoints"
        )
        circles = np.array(page.js(drawn))
        way = scene["pictures"]["ways"][-1]
        assert circles.ravel().tolist() == way["points"] and len(circles) >= 6
        assert page.js("document.querySelectorAll('#way circle.followed').length") == 1
        assert (
            page.js("document.querySelectorAll('#way path').length") == 2 * bool(way["lines"]) == 2
        )
        page.key("Escape", code=27)
    assert any(scene["plans"][0][0] > 0 for scene in scenes)


def test_every_failure_plays_to_its_end(page: Page) -> None:
    """Play runs until the failure while the map and both cameras change."""
    cards = page.js("document.querySelectorAll('[data-entry]').length")
    assert cards == 2
    page.js(
        "window.setInterval = ((real) => (what, ms) => real(what, ms / 25))(window.setInterval); 0"
    )
    for number in range(cards):
        page.js(f"document.querySelector('[data-entry=\"{number}\"]').click()")
        page.until(PICTURED)
        began = [page.js(what) for what in (DRAWN, "document.querySelector('#by-robot').src")]
        page.js("document.querySelector('#play').click()")
        page.until(
            "document.querySelector('#scrub').value === document.querySelector('#scrub').max"
        )
        page.until("document.querySelector('#play').textContent === 'Play'")
        page.until(PICTURED)
        ended = [page.js(what) for what in (DRAWN, "document.querySelector('#by-robot').src")]
        assert all(before != after for before, after in zip(began, ended, strict=True))
        assert page.js("document.querySelector('#clock').textContent") == "the failure"
        page.key("Escape", code=27)
    reasons = page.js("[...document.querySelectorAll('.card b')].map((b) => b.textContent)")
    assert any(
        "who came from the" in reason and "after the trigger" in reason for reason in reasons
    )
    assert any("who stood ahead" in reason for reason in reasons)


def test_the_viewer_works_with_the_keyboard(page: Page) -> None:
    """Enter opens, arrows step, End goes to the failure, Shift and arrow to another, Escape closes."""
    page.js("document.querySelector('[data-entry=\"0\"]').focus()")
    page.key("Enter", code=13)
    page.until("document.querySelector('#viewer').open")
    value = "Number(document.querySelector('#scrub').value)"
    page.key("ArrowRight", code=39)
    page.key("ArrowRight", code=39)
    assert page.js(value) == 2
    page.key("End", code=35)
    assert page.js(value) == page.js("Number(document.querySelector('#scrub').max)")
    reason = "document.querySelector('#viewer-reason').textContent"
    before = page.js(reason)
    page.key("ArrowRight", shift=True, code=39)
    assert page.js(reason) != before and page.js(value) == 0
    page.key(" ", code=32)
    page.until(f"{value} > 0")
    page.key("Escape", code=27)
    page.until("!document.querySelector('#viewer').open")


def test_a_phone_and_paper_show_the_whole_page(page: Page) -> None:
    """At 400 px only tables that scroll exceed the screen, and the page prints."""
    assert page.js(WIDE) <= 1280
    page.size(400, 850, phone=True)
    page.until(f"{WIDE} <= 400 && document.querySelector('.main-svg').clientWidth <= 400")
    page.js("document.querySelector('[data-entry=\"0\"]').click()")
    page.until(PICTURED)
    assert page.js("document.querySelector('#viewer').scrollWidth") <= 400
    page.key("Escape", code=27)
    printed = base64.b64decode(page.call("Page.printToPDF", printBackground=True)["data"])
    assert printed.startswith(b"%PDF") and len(printed) > 20_000


@pytest.fixture(scope="module")
def crowded_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of six runs with long names of policies and scenarios, without replays."""
    folder = tmp_path_factory.mktemp("crowded")
    rng = np.random.default_rng(1)
    kinds = ["straight", "curve", "crosswalk"]
    ways = [short_way(f"way-{k}", structure=kinds[k % 3], place=City(seed=k % 2)) for k in range(9)]
    ways += [
        short_way(f"long-{k}", ends_on_failure=False, time_limit_s=300.0, structure="route")
        for k in range(4)
    ]
    names = ["x" * 70, *(f"a-rather-long-policy-name-{k}-2026-11-24" for k in range(5))]
    hows = [[*rng.choice(["goal", HIT, "crashed"], 9).tolist(), *["goal"] * 3, HIT] for _ in names]
    runs = read_runs(
        [run_of(folder / f"run-{k}", hows[k], name, ways) for k, name in enumerate(names)]
    )
    spots = {
        place: [
            Spot(
                x_m=9.0 * k,
                y_m=5.0,
                cause=CAUSES[k % 5],
                words=f"way-{k} ({name}), 12.3 s: drove into <a wall>",
            )
        ]
        for place in episode_counts(runs)
        for k, name in enumerate(names)
    }
    pictures = [PlacePicture(place=one, image=PIXEL, bounds=(0.0, 0.0, 50.0, 9.0)) for one in spots]
    maps = Maps(pictures, spots, dict(episode_counts(runs)))
    path = folder / "crowded.html"
    path.write_bytes(
        render_page(runs, plots_of(runs, colours_of(runs)), [], maps, "nothing was shown again")
    )
    return path


def test_no_text_is_cut_off_or_covered(crowded_page: Path, browser: Page) -> None:
    """At 1280 and 400 px texts of plots, also of touched points, fit without overlap, and names
    take under half of a table."""
    browser.size(1280, 900)
    browser.open(crowded_page)
    plots = "[...document.querySelectorAll('.drawing')]"
    for wide in (1280, 400):
        browser.size(wide, 900, phone=wide == 400)
        browser.until(f"innerWidth === {wide}")
        browser.until(
            f"{plots}.every((p) => !p.dataset.plot || p.dataset.wide === String(p.clientWidth))"
        )
        browser.until(
            f"{plots}.every((p) => p.querySelector('.main-svg')?.clientWidth === p.clientWidth)"
        )
        assert browser.js(CUT_OFF) == [] and browser.js(WIDE) <= wide
        assert browser.js(f"{plots}.length") == 4
        for number in range(4):
            browser.js(f"Plotly.Fx.hover({plots}[{number}], [{{curveNumber: 0, pointNumber: 0}}])")
            browser.until(f"{plots}[{number}].querySelectorAll('.hovertext').length > 0")
            assert browser.js(CUT_OFF) == []
            browser.js(f"Plotly.Fx.unhover({plots}[{number}])")
        names = (
            "[...document.querySelectorAll('.wide th[scope=row]')].map((head) => head.offsetWidth)"
        )
        assert browser.js(f"Math.max(...{names})") < 0.5 * wide
    assert browser.wrong == []


def test_plots_and_maps_are_drawn(page: Page) -> None:
    """Every plot has marks, the map of the chosen place has its failures, and each place can be
    chosen."""
    plots = page.js("document.querySelectorAll('[data-plot]').length")
    marks = (
        "[...document.querySelectorAll('[data-plot]')].filter((p) => p.querySelector('.point, "
        ".bars path')).length"
    )
    assert plots and page.js(marks) == plots
    page.until("document.querySelectorAll('#map .points path').length > 0")
    assert page.js("document.querySelectorAll('#map image').length") == 1
    buttons = page.js(
        "[...document.querySelectorAll('.modebar-btn')].map((button) => button.dataset.title)"
    )
    assert buttons == ["Pan", "Zoom", "Zoom in", "Zoom out", "Reset axes"], (
        "nothing that sends a chart anywhere"
    )
    places = page.js("document.querySelectorAll('#place option').length")
    assert places == page.js("document.querySelectorAll('#places tbody tr').length") > 0


def test_a_filter_shows_only_its_kind(page: Page) -> None:
    """A chosen kind shows its cards alone, and how many of how many."""
    page.js("const kind = document.querySelector('[data-field=kind]'); kind.value = 'lateral'; 0")
    page.js("document.querySelector('[data-field=kind]').dispatchEvent(new Event('change'))")
    shown = page.js(
        "[...document.querySelectorAll('.cards > li')].filter((c) => !c.hidden).map((c) => "
        "c.dataset.kind)"
    )
    assert shown == ["lateral"]
    assert page.js("document.querySelector('#shown').textContent") == "1 of 2 shown"
