"""Draws `assets/page/`: the page of `r2p dash`, with the emulated robot, in a browser.

Run it from the root of the project when the page looks different: `python -m docs.draw_pages`, or with the names of
some pictures. The robot drives in real time, so figures differ from run to run, and no test compares them. It needs
what `make test PEERS=1` installs.
"""

import asyncio
import base64
import contextlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from playwright.async_api import Browser

from tests.browser import install
from tests.browser.rig import SIZES, Tab, browser, serve

FOLDER = Path(__file__).parent / "assets" / "page"
PORT = 2323  # as in the pages

_SETTLED = 8.0  # seconds of figures
_QUALITY = 82  # of WebP, in percent


class View(NamedTuple):
    """A view in a window, these seconds after a condition in JavaScript is true."""

    address: str
    seconds: float = 2.0
    shown: str = "r2p.store.topics.has('odometry')"
    size: str = "desktop"
    scheme: Literal["light", "dark"] = "light"


VIEWS = {
    "overview": View("overview"),
    "overview-phone": View("overview", size="phone", scheme="dark"),
    "plots": View("plots/speed.value[0],encoder1.delta", 12.0),
    "graph": View("graph"),
    "slots": View("slots", 4.0, "document.querySelector('.slots .slot.owned')"),
    "map": View("map", 20.0),
    "parameters": View("parameters/ki", 1.0, "document.querySelector('[data-parameter=ki]')"),
}


@contextlib.contextmanager
def _robot() -> Iterator[str]:
    """The emulated robot, as the tutorial starts it."""
    program = str(Path(sys.executable).with_name("r2p"))
    command = [program, "sim", "triskar2", "--drive", "--allow-control", "--via", f"tcp-listen:{PORT}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        try:
            assert child.stdout is not None
            yield next(found[1] for line in child.stdout if (found := re.search(r"--via (tcp:\S+)", line)))
        finally:
            child.terminate()


async def _draw(opened: Browser, url: str, name: str) -> int:
    """Draw a picture, and return its size in bytes."""
    view = VIEWS[name]
    width, height = SIZES[view.size]
    scale = 2 if view.size == "phone" else 1
    context = await opened.new_context(
        viewport={"width": width, "height": height}, color_scheme=view.scheme, device_scale_factor=scale
    )
    tab = Tab(await context.new_page(), url)
    await tab.page.goto(f"{url}#/{view.address}")
    await tab.until(view.shown)
    await asyncio.sleep(view.seconds)
    session = await context.new_cdp_session(tab.page)
    shot = await session.send("Page.captureScreenshot", {"format": "webp", "quality": _QUALITY})
    data = base64.b64decode(shot["data"])
    (FOLDER / f"{name}.webp").write_bytes(data)
    await context.close()
    sys.stdout.writelines(f"{name}: {problem}\n" for problem in tab.problems)
    return len(data)


async def _draw_all(program: Path, names: list[str]) -> None:
    with _robot() as via:
        async with serve(via, publish=True, control=True) as dash, browser(program) as opened:
            await asyncio.sleep(_SETTLED)
            for name in names:
                size = await _draw(opened, dash.server.url, name)
                sys.stdout.write(f"{name}: {size / 1000:.0f} kB\n")


def main() -> None:
    """Draw the pictures, unless there is no browser."""
    program = install.find()
    if isinstance(program, str):
        sys.exit(program)
    FOLDER.mkdir(parents=True, exist_ok=True)
    asyncio.run(_draw_all(program, sys.argv[1:] or list(VIEWS)))


if __name__ == "__main__":
    main()
