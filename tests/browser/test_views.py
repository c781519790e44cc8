"""Each view, at the size of a phone and of a desktop: it shows what the process knows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.browser.rig import SIZES, Dash, tab

if TYPE_CHECKING:
    from playwright.async_api import Browser

pytestmark = [pytest.mark.xdist_group("browser"), pytest.mark.processes]


@pytest.mark.parametrize("size", SIZES)
async def test_the_page_has_the_figures_of_the_process(browser: Browser, dash: Dash, size: str) -> None:
    async with tab(browser, dash.server.url, size) as page:
        await page.until("r2p.store.topics.has('odometry') && r2p.store.topics.has('encoder1')")
        await page.until("r2p.store.time >= argument", dash.monitor.snapshot.time)
        shown = await page.evaluate("() => [...r2p.store.topics.values()].map(each => [each.name, each.size])")
        assert dict(shown) == {each.name: each.size for each in dash.monitor.snapshot.topics}
        assert (await page.page.title()) == dash.monitor.snapshot.network
