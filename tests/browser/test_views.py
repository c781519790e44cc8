"""Each view, at the size of a phone and of a desktop: it shows what the process knows, and everyone can use it."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Literal

import pytest

from r2p.web.dash import protocol
from tests.browser import looks
from tests.browser.rig import SCHEMES, SIZES, Dash, Tab, opened

if TYPE_CHECKING:
    from playwright.async_api import Browser

pytestmark = [pytest.mark.xdist_group("browser"), pytest.mark.processes]

TABLES = ("modules", "topics", "services", "links", "buses")
STORE = """tables => ({
    time: r2p.store.time,
    ...Object.fromEntries(tables.map(table => [table, [...r2p.store[table].values()]])),
})"""
IS_SEEN = """(() => {
    const frame = document.getElementById("views").getBoundingClientRect()
    const link = document.querySelector("#views [aria-current]").getBoundingClientRect()
    return frame.left <= link.left && link.right <= frame.right && frame.top <= link.top && link.bottom <= frame.bottom
})()"""
VIEWS = "() => [...document.querySelectorAll('#views a')].map(each => each.dataset.view)"


async def figures(tab: Tab, dash: Dash) -> dict[str, list[dict[str, Any]]]:
    """The figures of the page, once they are those of the newest snapshot; and they are the same."""
    while True:
        snapshot = dash.monitor.snapshot
        shown: dict[str, Any] = await tab.evaluate(STORE, TABLES)
        if float(shown["time"]) == float(snapshot.time):
            break
    for table in TABLES:
        known = json.loads(protocol.encode(getattr(snapshot, table)))
        assert sorted(shown[table], key=str) == sorted(known, key=str), table
    return shown


@pytest.mark.parametrize("size", SIZES)
async def test_the_page_has_the_figures_of_the_process(browser: Browser, dash: Dash, size: str) -> None:
    async with opened(browser, dash.server.url, size) as tab:
        await tab.until("r2p.store.topics.has('odometry') && r2p.store.modules.size >= 7")
        shown = await figures(tab, dash)
        assert len(shown["topics"]) >= 15
        assert len(await tab.evaluate("() => [...document.querySelectorAll('#view tbody tr')]")) >= len(shown["topics"])


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("size", SIZES)
async def test_each_view_can_be_used(browser: Browser, dash: Dash, size: str, scheme: Literal["light", "dark"]) -> None:
    async with opened(browser, dash.server.url, size, scheme) as tab:
        await tab.until("r2p.store.topics.has('odometry')")
        found = {}
        for view in await tab.evaluate(VIEWS):
            await tab.evaluate("view => r2p.open(view)", view)
            await tab.until("document.querySelector('#views [aria-current]')?.dataset.view === argument", view)
            await tab.until(IS_SEEN)
            found[view] = await looks.problems(tab)
        assert {view: problems for view, problems in found.items() if problems} == {}
