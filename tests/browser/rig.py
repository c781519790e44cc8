"""A robot, the server of its page, and a browser that looks at it."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

from r2p.tools.dash import live_source
from r2p.tools.session import Settings, join
from r2p.web.dash.session import PATH, endpoint, page
from r2p.web.server import WebOptions, WebServer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Coroutine, Iterator
    from contextlib import AbstractAsyncContextManager
    from pathlib import Path

    from playwright.async_api import Browser, ConsoleMessage, Page, Request, WebSocket

    from r2p.monitoring.monitor import NetworkMonitor

T = TypeVar("T")

PATIENCE = 60.0
"""Seconds after which what has not happened in a browser has failed."""
SIZES = {"phone": (390, 844), "desktop": (1280, 900)}
"""Of the windows, in CSS pixels."""
SCHEMES: tuple[Literal["light", "dark"], ...] = ("light", "dark")

_OPTIONS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-features=LocalNetworkAccessChecks",  # of new browsers: the server must be safe without them, too
]


class LoopThread:
    """An event loop in a thread of its own, for what lives longer than a test: the browser, and the page's server.

    Playwright's own loop, of its calls without `await`, would run in the thread of all other tests.
    """

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="browser")
        self._thread.start()

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine in the thread, and return its result. Raises TimeoutError after `PATIENCE`."""
        return asyncio.run_coroutine_threadsafe(asyncio.wait_for(coroutine, PATIENCE), self._loop).result()

    @contextlib.contextmanager
    def opened(self, context: AbstractAsyncContextManager[T]) -> Iterator[T]:
        """Keep a context open in one task of the thread."""
        end = asyncio.Event()
        entered: asyncio.Future[T] = self._loop.create_future()
        held = asyncio.run_coroutine_threadsafe(_hold(context, entered, end), self._loop)
        try:
            yield self.run(_result(entered))
        finally:
            self._loop.call_soon_threadsafe(end.set)
            held.result(PATIENCE)

    def close(self) -> None:
        """End the loop and its thread."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


async def _hold(context: AbstractAsyncContextManager[T], entered: asyncio.Future[T], end: asyncio.Event) -> None:
    try:
        async with context as value:
            entered.set_result(value)
            await end.wait()
    except BaseException as error:
        if entered.done():
            raise
        entered.set_exception(error)


async def _result(future: asyncio.Future[T]) -> T:
    return await future


class Dash(NamedTuple):
    """The server of a page, and what it shows: the network as the monitor sees it."""

    monitor: NetworkMonitor
    server: WebServer


@contextlib.asynccontextmanager
async def serve(
    via: str, *, publish: bool = False, control: bool = False, token: str | None = None
) -> AsyncIterator[Dash]:
    """What `r2p dash` does, in this process: what the page shows can be compared with what the monitor knows."""
    async with (
        join(Settings(via=[via])) as session,
        live_source(session, allow_publish=publish, allow_control=control) as source,
        WebServer(WebOptions(token=token), {PATH: endpoint(source)}, page()) as server,
    ):
        yield Dash(source.monitor, server)


@contextlib.asynccontextmanager
async def browser(program: Path) -> AsyncIterator[Browser]:
    """Chromium, without a screen."""
    from playwright.async_api import async_playwright  # it is not in every environment

    async with async_playwright() as playwright:
        started = await playwright.chromium.launch(executable_path=program, args=_OPTIONS)
        try:
            yield started
        finally:
            await started.close()


class Tab:
    """A page in the browser, and what is wrong with it: what it complains of, and what it loads from elsewhere."""

    def __init__(self, page: Page, url: str) -> None:
        self.page = page
        self.problems: list[str] = []
        self.expected: tuple[str, ...] = ()
        """Parts of complaints that a test provokes."""
        self._own = url.partition("#")[0]
        page.on("console", self._console)
        page.on("pageerror", lambda error: self.problems.append(f"error of the page: {error}"))
        page.on("request", self._request)
        page.on("websocket", self._websocket)

    async def evaluate(self, script: str, argument: object = None) -> Any:
        """Run JavaScript in the page, and return its value."""
        return await self.page.evaluate(script, argument)

    async def until(self, condition: str, argument: object = None) -> None:
        """Wait until a condition in JavaScript is true. Playwright's own way to wait is forbidden by the page's CSP."""
        script = f"async argument => {{ while (!({condition})) await new Promise(done => setTimeout(done, 20)) }}"
        try:
            await asyncio.wait_for(self.page.evaluate(script, argument), PATIENCE / 2)
        except TimeoutError:
            raise AssertionError(f"the page waits for: {condition}") from None

    def _console(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning") and not any(each in message.text for each in self.expected):
            self.problems.append(f"{message.type} on the console: {message.text}")

    def _request(self, request: Request) -> None:
        if not request.url.startswith((self._own, "data:", "blob:")):
            self.problems.append(f"loads {request.url}")

    def _websocket(self, socket: WebSocket) -> None:
        if not socket.url.startswith(self._own.replace("http", "ws", 1)):
            self.problems.append(f"connects to {socket.url}")


@contextlib.asynccontextmanager
async def opened(
    browser: Browser, url: str, size: str = "desktop", scheme: Literal["light", "dark"] = "light"
) -> AsyncIterator[Tab]:
    """Open a page at this address; at the end there must have been no problems."""
    width, height = SIZES[size]
    context = await browser.new_context(
        viewport={"width": width, "height": height}, color_scheme=scheme, reduced_motion="reduce"
    )
    try:
        tab = Tab(await context.new_page(), url)
        await tab.page.goto(url)
        yield tab
    finally:
        await context.close()
    assert tab.problems == []
