"""What people do in the views reaches the robot, and what happens there reaches the views."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, NamedTuple

import pytest

import r2p
from r2p.msg import Led, Velocity3
from r2p.names import BUS_LOAD, BUS_SLOTS
from tests.browser import looks
from tests.browser.rig import Dash, Tab, opened

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Generator

    from playwright.async_api import Browser

    from tests.browser.rig import LoopThread

pytestmark = [pytest.mark.xdist_group("browser"), pytest.mark.processes]

VALUE = """(await r2p.connection.request("parameters", {module: "MOTOR1"}).catch(() => []))
    .some(each => each.node === "motor" && each.name === "ki" && each.value === argument)"""
"""Asks the module: only once the page shows the value, as such questions take all that the bus has left."""
SILENT = """() => {
    const request = r2p.connection.request.bind(r2p.connection)
    let left = 3
    r2p.connection.request = (op, asked) =>
        op === "describe" && left-- > 0 ? Promise.reject(new Error("silent")) : request(op, asked)
}"""
"""Makes the first three questions for a type fail, as those to a busy module do."""
LINES = "[...document.querySelectorAll('.log li')].map(each => each.textContent)"


class Computer(NamedTuple):
    """Another module of the network, of which a node warns all the time, and what another one was sent."""

    received: asyncio.Queue[Led]


@contextlib.asynccontextmanager
async def computer(via: str) -> AsyncIterator[Computer]:
    started: asyncio.Future[Computer] = asyncio.get_running_loop().create_future()

    async def panel(node: r2p.Node) -> None:
        found = Computer(asyncio.Queue())
        node.subscribe("leds", Led, found.received.put_nowait)
        node.serve("turn", Velocity3, Velocity3, turn)
        started.set_result(found)
        while True:
            await node.spin()

    async def watch(node: r2p.Node) -> None:
        async for _ in node.every(0.25):
            node.log.warning("the <b>door</b> is open")
            node.log.warning("the window is open")

    async def turn(request: Velocity3) -> Velocity3:
        return Velocity3(x=-request.y, y=request.x, w=request.w)

    async with r2p.Module("PC2", via=via) as module:
        module.start(panel)
        module.start(watch)
        yield await started


@pytest.fixture(scope="module")
def pc(loop_thread: LoopThread, robot: str) -> Generator[Computer, None, None]:
    with loop_thread.opened(computer(robot)) as found:
        yield found


async def show(tab: Tab, view: str, condition: str, argument: object = None) -> None:
    """Open a view, and wait until it shows what it should; it must look right then, too."""
    await tab.evaluate("view => { location.hash = `#/${view}` }", view)
    await tab.until(condition, argument)
    assert await looks.problems(tab) == []


async def test_a_message_is_published_from_a_form(browser: Browser, dash: Dash, pc: Computer) -> None:
    async with opened(browser, dash.server.url, "phone") as tab:
        await tab.until("r2p.store.topics.get('leds')?.subscribers?.some(each => each.module === 'PC2')")
        await show(tab, "publish/leds", "document.querySelector('[data-field=value]')")
        await tab.page.fill("[data-field=led]", "3")
        await tab.page.fill("[data-field=value]", "1000")
        await tab.page.press("[data-field=value]", "Enter")
        await tab.until("document.querySelector('[data-field=value]').getAttribute('aria-invalid') === 'true'")
        await tab.page.fill("[data-field=value]", "7")
        await tab.page.press("[data-field=value]", "Enter")
        assert await pc.received.get() == Led(led=3, value=7)


@pytest.mark.usefixtures("pc")
async def test_a_service_is_called(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url) as tab:
        await tab.until("r2p.store.services.has('turn')")
        await tab.evaluate(SILENT)
        await show(tab, "services/turn", "document.querySelector('[data-field=x]')")
        await tab.page.fill("[data-field=x]", "1.5")
        await tab.page.press("[data-field=x]", "Enter")
        await tab.until("document.querySelector('.result')?.textContent.includes('1.5')")
        assert '"y": 1.5' in await tab.page.inner_text(".result")


async def test_a_parameter_is_set_and_reset(browser: Browser, dash: Dash) -> None:
    row = "[data-module=MOTOR1] [aria-label='MOTOR1/motor'] [data-parameter=ki]"
    async with opened(browser, dash.server.url) as tab:
        await tab.until("r2p.store.modules.has('MOTOR1')")
        await show(tab, "parameters/ki", "document.querySelector(argument)", row)
        await tab.page.fill(f"{row} input", "20000")
        await tab.page.press(f"{row} input", "Enter")
        await tab.until("document.querySelector(argument)?.getAttribute('aria-invalid') === 'true'", f"{row} input")
        await tab.page.fill(f"{row} input", "25")
        await tab.page.press(f"{row} input", "Enter")
        await tab.until("document.querySelector(argument).textContent.includes('from run time')", row)
        await tab.until(VALUE, 25)
        await tab.page.click(f"{row} button")
        await tab.until("document.querySelector(argument).textContent.includes('from code')", row)
        await tab.until(VALUE, 30)


@pytest.mark.usefixtures("pc")
async def test_log_records_arrive_and_are_filtered(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url, "phone", "dark") as tab:
        await tab.until("r2p.hello !== null")
        await show(tab, "log", f"{LINES}.some(each => each.includes('<b>door</b>'))")
        await tab.page.keyboard.press("/")
        await tab.page.keyboard.type("window pc2")
        await tab.until(f"{LINES}.length > 0 && {LINES}.every(each => each.includes('window'))")
        assert await looks.problems(tab) == []


@pytest.mark.parametrize("size", ["phone", "desktop"])
async def test_the_slots_are_those_of_the_bus(browser: Browser, dash: Dash, size: str) -> None:
    async with opened(browser, dash.server.url, size) as tab:
        await tab.until("[...r2p.store.buses.values()].some(each => each.slots_in_cycle)")
        await show(tab, "slots", "document.querySelectorAll('.slots .slot.owned').length > 0")
        (bus,) = dash.monitor.snapshot.buses
        shown = await tab.evaluate(
            "() => ['', '.owned', '.sync'].map(each => document.querySelectorAll(`.slots .slot${each}`).length)"
        )
        owned = {slot for each in bus.slots if each.topic for slot in each.slots if slot}
        assert shown == [bus.slots_in_cycle, len(owned), 1]


async def test_the_graph_has_all_nodes_and_says_so_in_words(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url) as tab:
        await tab.until("r2p.store.topics.has('odometry') && r2p.store.topics.has('speed')")
        await show(tab, "graph", "document.querySelectorAll('#view svg text').length > 20")
        topics = [topic for topic in dash.monitor.snapshot.topics if topic.name not in (BUS_LOAD, BUS_SLOTS)]
        nodes = {f"{each.module}/{each.node}" for topic in topics for each in topic.publishers}
        words = [each for each in nodes if not each.endswith("/log")] + [
            "odometry",
            "speed",
            "encoder1",
            "velocity_cmd",
        ]
        texts = "[...document.querySelectorAll('#view svg text')].map(each => each.textContent)"
        await tab.until(f"argument.every(each => {texts}.includes(each))", words)


async def test_the_map_follows_the_odometry(browser: Browser, dash: Dash) -> None:
    points = "Number(document.querySelector('tr[data-topic=odometry] td:last-child')?.textContent)"
    async with opened(browser, dash.server.url, "phone") as tab:
        await tab.until("r2p.store.topics.has('odometry')")
        await show(tab, "map", f"{points} >= 3")
        first = await tab.evaluate(f"() => {points}")
        await tab.until(f"{points} > argument", first)


async def test_the_nodes_are_those_of_the_modules(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url, "phone") as tab:
        await tab.until("r2p.store.modules.get('MOTOR1')?.nodes?.length > 0")
        await show(tab, "nodes", "document.getElementById('view').textContent.includes('invkin')")
        text = await tab.page.inner_text("#view")
        for module in dash.monitor.snapshot.modules:
            assert module.name in text
