"""A recording in the browser: the same views, and the time line below them."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Literal

import pytest

from r2p.web.dash.recorded.source import RecordedSource
from r2p.web.dash.session import PATH, endpoint, page
from r2p.web.server import WebOptions, WebServer
from tests.browser import looks
from tests.browser.rig import Dash, Tab, opened
from tests.browser.test_views import VIEWS
from tests.web.dash.recordings import SECONDS, drive

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from playwright.async_api import Browser

pytestmark = [pytest.mark.xdist_group("browser"), pytest.mark.processes]

LOADED = "() => performance.getEntriesByType('resource').filter(each => each.name.includes('timeline')).length"
AT = "Math.abs(r2p.timeline.time - r2p.timeline.start - argument) < 0.2"
LENGTH = SECONDS - 0.01


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive(tmp_path_factory.mktemp("recordings") / "drive.mcap")


@contextlib.asynccontextmanager
async def shown(
    browser: Browser, recording: Path, size: str = "desktop", scheme: Literal["light", "dark"] = "light"
) -> AsyncIterator[Tab]:
    """A page with a recording that was read through."""
    async with (
        RecordedSource([recording]) as source,
        WebServer(WebOptions(), {PATH: endpoint(source)}, page()) as server,
        opened(browser, server.url, size, scheme) as tab,
    ):
        await tab.until("window.r2p?.timeline?.share === 1 && r2p.store.topics.has('wheels')")
        yield tab


async def test_each_view_of_a_recording_can_be_used(browser: Browser, recording: Path) -> None:
    async with shown(browser, recording, "phone", "dark") as tab:
        await tab.page.get_by_role("button", name="events").click()
        found = {}
        views = await tab.evaluate(VIEWS)
        assert {"overview", "plots", "graph", "slots", "log", "parameters"} <= set(views)
        assert not {"publish", "services"} & set(views)
        for view in views:
            await tab.evaluate("view => r2p.open(view)", view)
            await tab.until("document.querySelector('#views [aria-current]')?.dataset.view === argument", view)
            found[view] = await looks.problems(tab)
        assert {view: problems for view, problems in found.items() if problems} == {}


async def test_the_time_line_goes_where_it_is_asked_to(browser: Browser, recording: Path) -> None:
    async with shown(browser, recording) as tab:
        slider = tab.page.get_by_role("slider", name="Time in the recording")
        await tab.until(AT, LENGTH)
        await slider.press("Home")
        await tab.until(AT, 0)
        await slider.press("Shift+ArrowRight")
        await tab.until(AT, LENGTH / 5)
        await tab.until("r2p.store.topics.get('wheels').missed === 3")
        box = await slider.bounding_box()
        assert box is not None
        await tab.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + 20)
        await tab.until(AT, LENGTH / 2)
        await tab.until("r2p.store.topics.get('wheels').rate === 0")  # within the gap
        assert await slider.get_attribute("aria-valuetext") == "0:09.9 of 0:19.9"
        await tab.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 20)
        await tab.page.mouse.wheel(0, -300)
        await slider.press("End")
        await tab.until(AT, LENGTH)
        await slider.press("0")


async def test_events_are_a_list_whose_times_can_be_chosen(browser: Browser, recording: Path) -> None:
    async with shown(browser, recording) as tab:
        await tab.page.get_by_role("button", name="events").click()
        table = tab.page.get_by_role("region", name="Table of events").get_by_role("row")
        assert await table.count() == 1 + await tab.evaluate("() => r2p.timeline.marks.events.length")
        await tab.page.get_by_label("Kind").select_option("missed")
        assert await table.count() == 2
        assert "wheels of ROBOT/drive" in await table.nth(1).inner_text()
        await table.nth(1).get_by_role("button").click()
        await tab.until(AT, 5)


async def test_a_recording_plays_and_pauses(browser: Browser, recording: Path) -> None:
    async with shown(browser, recording) as tab:
        await tab.page.get_by_label("Rate").select_option("10")
        await tab.page.keyboard.press("p")  # from the start, as it is at the end
        await tab.until("r2p.timeline.playing && r2p.timeline.time < r2p.timeline.end - 1")
        await tab.page.get_by_role("button", name="Pause", exact=True).last.click()
        await tab.until("!r2p.timeline.playing")
        assert await tab.page.get_by_role("button", name="Play").count() == 1


async def test_a_plot_is_of_the_whole_recording(browser: Browser, recording: Path) -> None:
    async with shown(browser, recording) as tab:
        await tab.evaluate("() => r2p.open('plots', 'wheels.left')")
        await tab.until("r2p.stats.points >= 1600")


async def test_a_running_network_has_no_time_line(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url) as tab:
        await tab.until("r2p.store.topics.has('odometry')")
        assert await tab.evaluate(LOADED) == 0
        assert await tab.page.locator("#timeline").is_hidden()
