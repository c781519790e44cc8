"""The checks of views find what they are for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.browser import looks
from tests.browser.rig import Tab, opened

if TYPE_CHECKING:
    from playwright.async_api import Browser

pytestmark = [pytest.mark.xdist_group("browser"), pytest.mark.processes]

GOOD = """<!doctype html><html lang="en"><title>good</title><style>button, input { min-height: 30px }</style>
<h1>A page</h1><main><h2>A part</h2><p>Text, and <a href="#x">a link</a></p><label>Name <input></label>
<table><caption>Rows</caption><tr><th aria-sort="none"><button>Sort</button></th></tr><tr><td>1</td></tr></table>
<canvas role="img" aria-label="A curve"></canvas></main>"""
BAD = {
    '<p style="color: #888">pale</p>': ["contrast 3.54 instead of 4.5: <p> pale"],
    '<p style="color: #0000008a">pale</p>': [],
    '<div style="background: #333"><p style="color: #444">dark</p></div>': ["contrast 1.30 instead of 4.5: <p> dark"],
    '<p style="opacity: .3">faint</p>': ["contrast 2.11 instead of 4.5: <p> faint"],
    '<input placeholder="what" aria-label="x" style="color: #ddd">': [],
    '<div style="width: 3000px">wide</div>': ["the page scrolls sideways", "cut off at the side: <div> wide"],
    '<div style="overflow: auto"><div style="width: 3000px">wide</div></div>': [],
    '<div style="overflow: hidden"><p style="width: 3000px">wide</p></div>': ["cut off at the side: <p> wide"],
    '<button style="all: unset; display: block; width: 9px; height: 30px">x</button>': [
        "9x30 px is too small to hit: <button> x"
    ],
    '<button><svg width="30" height="30"></svg></button>': ["button without a name"],
    '<img src="data:,">': ["image without a name"],
    "<canvas></canvas>": ["a canvas without a name: <canvas>"],
    "<input>": ["textbox without a name"],
    "<h4>Deep</h4>": ["a heading h4 after h2: <h4> Deep"],
    "<h1>Two</h1>": ["2 headings h1"],
    '<p id="a">1</p><p id="a">2</p>': ["two elements have the id a"],
    '<p aria-labelledby="missing">1</p>': ["aria-labelledby names missing, which is not there: <p> 1"],
    '<p tabindex="2">1</p>': ["its own place in the order of Tab: <p> 1"],
    "<table><tr><td>1</td></tr></table>": ["a table without heads: <table> 1", "a table without a name: <table> 1"],
    '<table aria-label="x"><tr><th><button>Sort</button></th></tr></table>': [
        "a table that does not say how it is sorted: <button> Sort"
    ],
}


async def test_what_is_wrong_with_a_page_is_found(browser: Browser) -> None:
    async with opened(browser, "about:blank") as tab:
        assert await _problems(tab, "") == []
        found = {part: await _problems(tab, part) for part in BAD}
        assert {part: problems for part, problems in found.items() if problems != BAD[part]} == {}


async def _problems(tab: Tab, part: str) -> list[str]:
    await tab.page.set_content(GOOD.replace("</main>", f"{part}</main>"))
    return await looks.problems(tab)
