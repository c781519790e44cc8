"""Plots, and what a topic's detail shows: with the robot's figures, and with points of which the result is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.browser.rig import Dash, opened

if TYPE_CHECKING:
    from playwright.async_api import Browser

pytestmark = [pytest.mark.xdist_group("browser"), pytest.mark.processes]

LINK = "#/plots/odometry.pose.x+odometry.pose.y,encoder1.delta"
VALUES = "[...document.querySelectorAll('.legend .value')].map(each => each.textContent)"

RESTS = """(() => {
    if (window.seen?.redraws !== r2p.stats.redraws) window.seen = { ...r2p.stats }
    return r2p.stats.points > window.seen.points + 3
})()"""

THINNED = """async () => {
    const { Series, Steps, POINTS_MAX } = await import("/series.js")
    const series = new Series(), wrong = []
    series.addField("a.x")
    const step = 0.05, size = 40
    const steps = new Steps(series, "a.x", step, size)
    let time = 1.7e9, seed = 1
    const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647
    const check = () => {
        const to = Math.floor(series.last / step), from = to - size + 3, values = []
        steps.read(from, to, values)
        for (let at = from; at <= to; at++) {
            const here = []
            for (let index = series.indexAt(at * step - 1); index < series.length; index++)
                if (Math.floor(series.times[index] / step) === at) here.push(series.columns.get("a.x")[index])
            const known = here.filter(each => !Number.isNaN(each))
            const drawn = values.slice(2 * (at - from), 2 * (at - from) + 2).filter(each => typeof each === "number")
            const isGap = values[2 * (at - from)] === null
            if (isGap !== (here.length > 0 && !known.length)) wrong.push(`gap in ${at - from}`)
            if (Math.min(...known) !== Math.min(...drawn) || Math.max(...known) !== Math.max(...drawn))
                wrong.push(`${at - from}: ${known} drawn as ${drawn}`)
        }
    }
    for (let batch = 0; batch < 200; batch++) {
        const times = Float64Array.from({ length: 1 + batch % 7 }, () => time += 0.2 * random() ** 3)
        series.append(["a.x"], times, [times.map(() => random() < 0.2 ? NaN : random())])
        check()
    }
    const many = Float64Array.from({ length: POINTS_MAX - 5 }, () => time += 1e-4)
    for (let batch = 0; batch < 3; batch++) {
        series.append(["a.x"], many.map(each => each + batch * 20), [many.map(random)])
        check()
    }
    const all = series.length + series.dropped
    return { wrong, kept: series.length >= POINTS_MAX, all, bounded: series.times.length }
}"""

SAVED = """async () => {
    const { Series, csv } = await import("/series.js")
    const one = new Series(), other = new Series()
    one.addField("a.x")
    other.addField("b.y")
    one.append(["a.x"], Float64Array.of(1, 2, 3), [Float64Array.of(10, NaN, 30)])
    other.append(["b.y"], Float64Array.of(2, 2.5, 9), [Float64Array.of(-1, -2, -3)])
    const fields = [{ name: "a.x", series: one, field: "a.x" }, { name: 'b."y"', series: other, field: "b.y" }]
    return csv(fields, 1.5, 5).join("")
}"""


async def test_a_link_opens_plots_and_the_address_keeps_them(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url + LINK) as tab:
        await tab.until("r2p.stats.points > 20 && r2p.stats.redraws > 2")
        await tab.until(f"{VALUES}.length === 3 && {VALUES}.every(each => Number.isFinite(Number(each)))")
        assert await tab.evaluate("() => document.querySelectorAll('.plot canvas').length") == 2
        await tab.page.click("[aria-label='Remove odometry.pose.y']")
        await tab.until("location.hash === '#/plots/odometry.pose.x,encoder1.delta'")


async def test_fields_are_found_by_words_and_a_paused_plot_rests(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url + "#/plots") as tab:
        await tab.until("r2p.store.topics.has('odometry')")
        await tab.page.keyboard.press("a")
        await tab.page.keyboard.type("odo pose.y")
        await tab.until("document.querySelectorAll('.choice').length === 1")
        await tab.page.keyboard.press("Enter")
        await tab.page.click("text=Done")
        await tab.until("location.hash === '#/plots/odometry.pose.y' && r2p.stats.redraws > 0")
        await tab.page.keyboard.press("p")
        await tab.until(RESTS)
        redraws = await tab.evaluate("() => r2p.stats.redraws")
        await tab.page.keyboard.press("+")
        await tab.until("r2p.stats.redraws > argument", redraws)


async def test_a_field_that_is_not_there_leaves_the_others(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url + "#/plots/odometry.pose.x+odometry.nothing") as tab:
        await tab.until("document.querySelector('.legend .failed')?.textContent.includes('has no number')")
        await tab.until(f"Number.isFinite(Number({VALUES}[0]))")


async def test_points_are_thinned_to_the_extremes_of_each_step(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url) as tab:
        found = await tab.evaluate(THINNED)
    assert found["wrong"] == []
    assert found["kept"]
    assert found["all"] > 400_000 >= found["bounded"]


async def test_csv_has_a_line_for_each_time(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url) as tab:
        saved = await tab.evaluate(SAVED)
    assert saved == 'time,a.x,"b.""y"""\n2.000000,,-1\n2.500000,,-2\n3.000000,30,\n'


async def test_a_topic_shows_its_fields_and_plots_them(browser: Browser, dash: Dash) -> None:
    async with opened(browser, dash.server.url, "phone") as tab:
        await tab.page.click("text=odometry >> nth=0")
        await tab.until("[...document.querySelectorAll('.fields th')].some(each => each.textContent === 'pose.x')")
        assert await tab.evaluate("() => document.activeElement.textContent") == "odometry"
        await tab.page.click("[aria-label='Plot odometry.pose.x']")
        await tab.until("location.hash === '#/plots/odometry.pose.x' && r2p.stats.points > 0")
        await tab.page.go_back()
        await tab.until("document.querySelector('.detail')?.hidden === false")
        await tab.page.keyboard.press("Escape")
        await tab.until("location.hash === '#/overview' && document.querySelector('.detail').hidden")
