"""The thesis's benchmark of the middleware (section 5.4) on short runs: what does not depend on the computer."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from benchmarks import middleware_thesis
from benchmarks.middleware_thesis import Burst, Latency, burst, local, memory, on_the_bus, remote
from r2p.sim import run

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

SLOT, FRAME = 166e-6, 144e-6  # s; the frame of 8 bytes that this benchmark sends, with its stuff bits


def test_slow_subscribers_do_not_delay_a_remote_one_at_all() -> None:
    def durations(low: int) -> list[float]:
        return run(lambda: remote(20, low, lambda: asyncio.get_running_loop().time()))

    alone, beside = durations(0), durations(5)
    later = alone[1:] + beside[1:]  # the slot of the first may be granted less than its lead before it starts
    assert all(abs(each - SLOT - FRAME) < 1e-9 for each in later)


def test_each_message_reaches_a_local_subscriber_beside_slow_ones() -> None:
    assert len(run(lambda: local(20, 4))) == 20


def test_a_burst_waits_for_all_its_subscribers() -> None:
    result = asyncio.run(burst(50, 3))
    assert result.rate > 0
    assert 0 < result.latency.p1 <= result.latency.p50 <= result.latency.p99


def test_the_bus_carries_nearly_what_its_slots_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(middleware_thesis, "BUS_SECONDS", 0.2)
    possible = 64 / 166e-6 / 1000 * 59 / 60  # kbit/s: one frame a slot, and the sync
    assert 0.97 * possible < run(on_the_bus) <= possible


def test_every_object_has_a_size() -> None:
    sizes = asyncio.run(memory())
    assert sizes.keys() == middleware_thesis.THESIS_MEMORY.keys()
    assert all(size > 0 for size in sizes.values())


def test_the_figure_has_a_point_for_each_number_of_subscribers(tmp_path: Path) -> None:
    bursts = {count: Burst(1e5 / count, Latency(3.0 * count, 1.0, 9.0)) for count in middleware_thesis.READY}
    middleware_thesis.draw(bursts, tmp_path / "figure.svg")
    dots = [each for each in ElementTree.parse(tmp_path / "figure.svg").iter() if each.tag.endswith("circle")]
    assert len(dots) == 2 * len(bursts)
