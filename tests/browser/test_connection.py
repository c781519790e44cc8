"""Who may connect, and what a page shows whose process is gone."""

from __future__ import annotations

import asyncio
import re
from typing import TYPE_CHECKING

import pytest

from tests.browser.rig import Dash, opened, serve
from tests.tools.rig import process

if TYPE_CHECKING:
    import subprocess

    from playwright.async_api import Browser

pytestmark = [pytest.mark.xdist_group("browser"), pytest.mark.processes]

OTHER = "http://localhost:9/"
TRY = """url => new Promise(resolve => {
    const socket = new WebSocket(url)
    socket.onopen = () => resolve("open")
    socket.onerror = () => resolve("refused")
})"""
HANG = "time => { const end = performance.now() + time; while (performance.now() < end); }"  # ms
ASK = "([op, values]) => r2p.connection.request(op, values).then(() => 'done', error => error.message)"
FORBIDDEN = {
    ("publish", "--allow-publish"): {"topic": "leds", "value": {"led": 1, "value": 1}},
    ("call", "--allow-publish"): {"service": "MOTOR1/reset", "value": {}},
    ("set_parameters", "--allow-control"): {"module": "MOTOR1", "node": "invkin", "values": {"x": 1}},
    ("save_parameters", "--allow-control"): {"module": "MOTOR1"},
    ("node", "--allow-control"): {"module": "MOTOR1", "node": "invkin", "order": "stop"},
    ("module", "--allow-control"): {"module": "MOTOR1", "order": "reboot"},
}


def url(child: subprocess.Popen[str]) -> str:
    """Where `r2p dash` serves its page."""
    assert child.stderr is not None
    return next(found[0] for line in child.stderr if (found := re.search(r"http://\S+", line)))


async def test_a_page_whose_process_is_killed_goes_on_with_the_next_one(browser: Browser, robot: str) -> None:
    with process("dash", "--port", "0", "--via", robot) as child:
        address = url(child)
        async with opened(browser, address) as tab:
            tab.expected = ("WebSocket connection to",)
            await tab.until("r2p.store.topics.has('odometry')")
            child.kill()
            await tab.until("document.getElementById('state').dataset.state === 'off'")
            kept = await tab.evaluate("() => r2p.store.topics.has('odometry')")
            assert kept, "what was known stays on the screen"
            port = address.rstrip("/").rpartition(":")[2]
            with process("dash", "--port", port, "--via", robot) as following:
                assert url(following) == address
                await tab.until("document.getElementById('state').dataset.state === 'on'")
                await tab.until("r2p.store.topics.has('odometry')")


async def test_the_link_has_the_token_and_the_address_bar_has_not(browser: Browser, robot: str) -> None:
    async with serve(robot, token="a secret+more") as dash:
        async with opened(browser, dash.server.url) as tab:
            await tab.until("r2p.hello !== null")
            assert "secret" not in tab.page.url
            await tab.page.reload()
            await tab.until("r2p.hello !== null")
        async with opened(browser, dash.server.url.partition("#")[0]) as stranger:
            stranger.expected = ("WebSocket connection to",)
            await stranger.until("document.getElementById('banner').textContent.includes('token')")
            assert await stranger.evaluate("() => r2p.store.topics.size") == 0
        assert dash.server.refused["token"] >= 1


async def test_a_page_of_another_origin_is_refused(browser: Browser, robot: str) -> None:
    async with serve(robot) as dash, opened(browser, "about:blank") as tab:
        await tab.page.route(
            f"{OTHER}**", lambda route: route.fulfill(body="<p>another page", content_type="text/html")
        )
        await tab.page.goto(OTHER)
        address = dash.server.url.replace("http", "ws", 1) + "dash"
        assert await tab.evaluate(TRY, address) == "refused"
        assert dash.server.refused == {"origin": 1}
        assert set(tab.problems) >= {f"loads {OTHER}", f"connects to {address}"}
        tab.problems.clear()


async def test_what_is_not_allowed_is_refused_and_the_option_is_named(browser: Browser, robot: str) -> None:
    async with serve(robot) as dash, opened(browser, dash.server.url) as tab:
        await tab.until("r2p.hello !== null")
        for (op, option), values in FORBIDDEN.items():
            answer = await tab.evaluate(ASK, [op, values])
            assert option in answer, f"{op}: {answer}"


async def test_a_page_that_hangs_keeps_no_other_waiting_and_goes_on_with_the_newest(
    browser: Browser, dash: Dash
) -> None:
    async with opened(browser, dash.server.url) as slow, opened(browser, dash.server.url) as other:
        for tab in (slow, other):
            await tab.until("r2p.store.topics.has('odometry')")
        hanging = asyncio.create_task(slow.evaluate(HANG, 2500))
        began = await other.evaluate("() => r2p.store.time")
        await other.until("r2p.store.time > argument", began)
        assert not hanging.done()
        await hanging
        await slow.until("r2p.store.time >= argument", dash.monitor.snapshot.time)
