"""All of the page without a mouse."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.browser import looks
from tests.browser.rig import Dash, opened

if TYPE_CHECKING:
    from playwright.async_api import Browser

pytestmark = [pytest.mark.xdist_group("browser"), pytest.mark.processes]

FOCUS = """() => {
    const element = document.activeElement, style = getComputedStyle(element)
    const isSeen = style.outlineStyle !== "none" || style.boxShadow !== "none"
    window.order = (window.order ?? []).concat(element)
    return {is: element.id || element.localName, isSeen, again: window.order.indexOf(element) < window.order.length - 1}
}"""
SHOWN = "document.querySelector('#views [aria-current]')?.dataset.view === argument"
TABS_MAX = 100


async def test_each_view_has_a_key(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url) as tab:
        await tab.until("r2p.store.topics.has('odometry')")
        views = await tab.evaluate("() => [...document.querySelectorAll('#views a')].map(each => each.dataset.view)")
        for number, view in reversed(list(enumerate(views, start=1))):
            await tab.page.keyboard.press(str(number % 10))
            await tab.until(SHOWN, view)


async def test_help_takes_the_keyboard_and_gives_it_back(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url) as tab:
        await tab.until("r2p.store.topics.has('odometry')")
        await tab.page.focus("#theme")
        await tab.page.keyboard.press("?")
        await tab.until("document.querySelector('dialog[open]')?.contains(document.activeElement)")
        assert await looks.problems(tab) == []
        await tab.page.keyboard.press("Escape")
        await tab.until("!document.querySelector('dialog[open]') && document.activeElement.id === 'theme'")


async def test_filter_and_pause(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url) as tab:
        await tab.until("r2p.store.topics.has('odometry')")
        await tab.page.keyboard.press("/")
        await tab.page.keyboard.type("odom")
        await tab.until("document.querySelector('#view table').querySelectorAll('tbody tr').length === 1")
        assert "odometry" in await tab.page.inner_text("#view tbody tr:not([hidden])")
        await tab.page.keyboard.press("Escape")
        await tab.page.focus("#view")
        await tab.page.keyboard.press("p")
        await tab.until("document.querySelector('[data-pause]').getAttribute('aria-pressed') === 'true'")
        await tab.page.keyboard.press(" ")
        await tab.until("document.querySelector('[data-pause]').getAttribute('aria-pressed') === 'false'")


async def test_tab_reaches_what_can_be_pressed_and_shows_where_it_is(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url) as tab:
        await tab.until("r2p.store.topics.has('odometry')")
        reached = []
        for _ in range(TABS_MAX):
            await tab.page.keyboard.press("Tab")
            found = await tab.evaluate(FOCUS)
            if found["is"] == "body" or found["again"]:
                break
            assert found["isSeen"], f"{found['is']} has the keyboard, and does not look like it"
            reached.append(found["is"])
        assert reached[0] == "skip"
        assert {"theme", "help", "input", "a"} <= set(reached)


FILTER = """words => {
    const filter = document.querySelector('.parameters-view [data-filter]')
    filter.value = words
    filter.dispatchEvent(new Event('input'))
}"""


async def test_what_comes_beside_it_takes_neither_the_keyboard_nor_a_click(browser: Browser, dash: Dash) -> None:
    """Others come when their answers do: in the middle of writing a value, or while the button of the mouse is down."""
    panels = "[...document.querySelectorAll('#view section.panel')].map(each => each.dataset.module).join()"
    kp = "[data-module=MOTOR2] [data-parameter=kp] input"
    async with opened(browser, dash.server.url) as tab:
        await tab.until("['MOTOR1', 'MOTOR2', 'MOTOR3'].every(each => r2p.store.modules.has(each))")
        await tab.evaluate("view => { location.hash = `#/${view}` }", "parameters/kp")
        await tab.until(f"{panels} === 'MOTOR1,MOTOR2,MOTOR3'")
        await tab.evaluate(FILTER, "motor2 kp")
        await tab.until(f"{panels} === 'MOTOR2'")
        await tab.page.fill(kp, "-7")
        await tab.page.hover(kp)
        await tab.evaluate("""() => {
            window.clicks = 0
            document.querySelector('[data-module=MOTOR2]').addEventListener('click', () => window.clicks++)
        }""")
        await tab.page.mouse.down()
        await tab.evaluate(FILTER, "kp")
        await tab.until(f"{panels} === 'MOTOR1,MOTOR2,MOTOR3'")
        assert await tab.evaluate("input => document.activeElement === document.querySelector(input)", kp)
        await tab.page.hover(kp)
        await tab.page.mouse.up()
        assert await tab.evaluate("() => window.clicks") == 1
        await tab.page.keyboard.press("Enter")
        await tab.until("document.querySelector(argument).getAttribute('aria-invalid') === 'true'", kp)


async def test_the_theme_is_kept(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url) as tab:
        await tab.until("r2p.hello !== null")
        back = "() => getComputedStyle(document.body).backgroundColor"
        light = await tab.evaluate(back)
        while await tab.evaluate(back) == light:
            await tab.page.keyboard.press("t")
        dark = await tab.evaluate(back)
        await tab.page.reload()
        await tab.until("r2p.hello !== null")
        assert await tab.evaluate(back) == dark
