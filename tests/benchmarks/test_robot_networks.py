"""iRobot's networks: their sizes, what is counted as late and lost, and a short run in this process."""

import asyncio

import pytest

from benchmarks.robot_networks import measuring
from benchmarks.robot_networks.plans import HEADER, MADE_UP, SIERRA_NEVADA, Plan
from benchmarks.robot_networks.r2p_end import Stamped, StampedFrame, work
from r2p import Module, layout
from r2p.codecs.rtcan import VARIABLE_MAX

MS = 1_000_000


@pytest.mark.parametrize(("plan", "sizes"), [(SIERRA_NEVADA, (10, 13, 17, 10_000)), (MADE_UP, (20, 23, 35, 250_000))])
def test_the_sizes_that_are_published(plan: Plan, sizes: tuple[int, ...]) -> None:
    topics = plan.topics
    subscriptions = plan.pairs([node.name for node in plan.nodes])
    assert (len(plan.nodes), len(topics), len(subscriptions), max(each.size for each in topics.values())) == sizes
    assert {topic for _, topic in subscriptions} <= set(topics)
    assert {*plan.half(0), *plan.half(1)} == set(plan.nodes)


def test_on_can_there_is_what_fits() -> None:
    small = SIERRA_NEVADA.up_to(VARIABLE_MAX)
    assert set(SIERRA_NEVADA.topics) - set(small.topics) == {"missouri"}
    assert all("missouri" not in node.subscribes for node in small.nodes)
    assert len(layout(StampedFrame).encode(StampedFrame(data=bytes(VARIABLE_MAX - HEADER)))) <= VARIABLE_MAX


def test_late_too_late_and_lost_are_irobots(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measuring, "now", lambda: 1_000 * MS)
    recorder = measuring.Recorder(SIERRA_NEVADA, ["lyon"])
    assert not recorder.connected.is_set()
    for counter, took in ((7, 1.9), (8, 2.1), (9, 10.0), (13, 10.1)):  # amazon: every 10 ms
        recorder.message("lyon", "amazon", counter, round((1_000 - took) * MS))
    assert recorder.connected.is_set()
    result = recorder.result()
    assert {name: result[name] for name in ("received", "late", "too_late", "lost")} == {
        "received": 4,
        "late": 2,
        "too_late": 1,
        "lost": 3,
    }
    recorder.begin()
    recorder.message("lyon", "amazon", 15, 1_000 * MS)  # what was lost meanwhile counts, too
    assert (recorder.received, recorder.lost) == (1, 1)


def test_slow_topics_have_5_and_50_milliseconds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measuring, "now", lambda: 1_000 * MS)
    recorder = measuring.Recorder(SIERRA_NEVADA, ["georgetown"])
    for counter, took in enumerate((4.9, 5.1, 49.9, 50.1)):
        recorder.message("georgetown", "lena", counter, round((1_000 - took) * MS))
    assert (recorder.late, recorder.too_late) == (2, 1)


@pytest.mark.virtual_time
async def test_r2p_runs_the_network() -> None:
    recorder = measuring.Recorder(SIERRA_NEVADA, [node.name for node in SIERRA_NEVADA.nodes])
    async with Module("ONE", via=[], watchdog=False) as module:
        for node in SIERRA_NEVADA.nodes:
            module.start(work, node, Stamped, recorder, name=node.name)
        await asyncio.sleep(2.001)
    assert recorder.connected.is_set()
    assert recorder.lost == 0
    per_second = sum(1 / SIERRA_NEVADA.topics[name].period for each in SIERRA_NEVADA.nodes for name in each.subscribes)
    assert recorder.received == pytest.approx(2 * per_second, abs=17)
