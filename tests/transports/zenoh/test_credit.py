"""Final credits that come after the end of a token, or not at all. In virtual time."""

import asyncio

import pytest

from r2p.transports.zenoh.credit import FINAL_CREDIT_S, FinalCredits

pytestmark = pytest.mark.virtual_time


class Bench:
    """Final credits, what they count, and a credit that is found by looking."""

    def __init__(self) -> None:
        self.counted: list[int] = []
        self.found: tuple[str, int] | None = None
        self.final_credits = FinalCredits(asyncio.get_running_loop(), self._look, self.counted.append)

    def _look(self) -> None:
        if self.found is not None:
            self.final_credits.received(*self.found)


async def test_a_last_credit_that_comes_late_leaves_nothing_unknown() -> None:
    bench = Bench()
    bench.final_credits.expect("leds", 1, 5)
    bench.final_credits.expect("leds", 2, 7)
    await asyncio.sleep(FINAL_CREDIT_S / 2)
    bench.final_credits.received("leds", 1)
    bench.final_credits.received("leds", 3)  # nothing is expected of it
    bench.final_credits.received("speed", 2)
    await asyncio.sleep(FINAL_CREDIT_S)
    assert bench.counted == [7]


async def test_one_that_is_found_at_the_end_is_in_time() -> None:
    bench = Bench()
    bench.final_credits.expect("leds", 1, 5)
    bench.found = "leds", 1
    await asyncio.sleep(2 * FINAL_CREDIT_S)
    assert bench.counted == []


async def test_one_that_came_back_and_is_gone_again_is_counted_once() -> None:
    bench = Bench()
    bench.final_credits.expect("leds", 1, 5)
    await asyncio.sleep(FINAL_CREDIT_S / 2)
    bench.final_credits.expect("leds", 1, 7)
    await asyncio.sleep(0.9 * FINAL_CREDIT_S)
    assert bench.counted == []
    await asyncio.sleep(FINAL_CREDIT_S)
    assert bench.counted == [12]


async def test_a_link_that_is_closed_waits_for_nothing() -> None:
    bench = Bench()
    bench.final_credits.expect("leds", 1, 5)
    bench.final_credits.expect("leds", 2, 7)
    bench.found = "leds", 1
    bench.final_credits.close()
    assert bench.counted == [7]
    await asyncio.sleep(2 * FINAL_CREDIT_S)
    assert bench.counted == [7]
