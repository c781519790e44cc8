"""The page of `r2p dash` in Chromium: frames drawn of 20 fields at 1 kHz, and how soon it shows something."""

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from benchmarks.dash import RATE, dash, processor_time, robot
from benchmarks.processes import process
from benchmarks.table import Row, typical
from tests.browser import install

if TYPE_CHECKING:
    from playwright.sync_api import Browser

TOPICS = 4  # as in the benchmark `dash`
FIELDS = 5  # of each topic
SECONDS = 10.0
RUNS = 5
PATIENCE = 60_000  # ms

_OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
_PLOTTED = """count => new Promise(resolve => {
    const check = () => r2p.stats.points > count ? resolve() : setTimeout(check, 20)
    check()
})"""
_FRAMES = """seconds => new Promise(resolve => {
    const before = {...window.r2p?.stats}
    let turns = 0, began = 0
    const turn = now => {
        began ||= now
        if (now - began < 1000 * seconds) {
            turns += 1
            requestAnimationFrame(turn)
        } else {
            const grown = Object.entries(window.r2p?.stats ?? {}).map(([name, value]) => [name, value - before[name]])
            resolve({...Object.fromEntries(grown), turns, seconds: (now - began) / 1000})
        }
    }
    requestAnimationFrame(turn)
})"""
_PAINTED = """() => new Promise(resolve => {
    const found = list => list.getEntriesByName("first-contentful-paint")[0]
    const tell = entry => resolve(performance.timeOrigin + entry.startTime)
    if (found(performance)) tell(found(performance))
    else new PerformanceObserver(list => found(list) && tell(found(list))).observe({type: "paint", buffered: true})
})"""


def _paint(browser: "Browser", via: str) -> float:
    """Return the seconds from the start of the process to the first text on the screen."""
    page = browser.new_page()
    began = time.time()
    with dash(via) as (_, url):
        page.goto(url, wait_until="commit")
        painted: float = page.evaluate(_PAINTED)
        page.close()
    return painted / 1000 - began


def _plot(browser: "Browser", via: str) -> tuple[dict[str, Any], float]:
    """Return what the page counts while it plots, and the share of a core that its server takes."""
    fields = [f"wave{topic}.{field}" for topic in range(TOPICS) for field in "abcde"]
    with dash(via) as (pid, url):
        page = browser.new_page()
        page.set_default_timeout(PATIENCE)
        page.goto(f"{url}#/plots/{','.join(fields)}")
        page.evaluate(_PLOTTED, int(TOPICS * FIELDS * RATE))
        before, began = processor_time(pid), time.perf_counter()
        counted: dict[str, Any] = page.evaluate(_FRAMES, SECONDS)
        share = (processor_time(pid) - before) / (time.perf_counter() - began)
        page.close()
    return counted, share


def _blank(browser: "Browser") -> float:
    """Return the frames a second of an empty page."""
    page = browser.new_page()
    counted = page.evaluate(_FRAMES, 2.0)
    page.close()
    return float(counted["turns"] / counted["seconds"])


def rows() -> Iterator[Row]:
    program = install.find()
    if isinstance(program, str):
        yield Row("the page in a browser", "skipped", program, "", None)
        return
    from playwright.sync_api import sync_playwright  # it is not in every environment

    with sync_playwright() as playwright, process(robot, TOPICS) as pipe:
        browser = playwright.chromium.launch(executable_path=program, args=_OPTIONS)
        via = f"tcp:127.0.0.1:{pipe.recv()}"
        paint = typical(RUNS, lambda: _paint(browser, via))
        empty = _blank(browser)
        counted, share = _plot(browser, via)
        browser.close()
    frames = counted["frames"] / counted["seconds"]
    lost = 1 - counted["points"] / (counted["seconds"] * TOPICS * FIELDS * RATE)
    yield Row("r2p dash: from its start to the first paint", f"{paint:.2f} s", "", "1.5 s", paint <= 1.5)
    text = f"an empty page: {empty:.0f} frames/s"
    what = f"{TOPICS * FIELDS} fields at {RATE / 1000:.0f} kHz"
    yield Row(f"{what}, drawn", f"{frames:.0f} frames/s", text, "30 frames/s", frames >= 30)
    yield Row(f"{what}, points that arrive", f"{1 - lost:.1%}", "", "", None)
    yield Row(f"{what}, processor time of r2p dash", f"{share:.0%} of a core", "", "30 %", share <= 0.3)
