"""The topic `log`: rate limit, what does not fit into a record, and that it never feeds itself."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.modules.log_topic import LOG_RATE
from r2p.msg import Led, Log
from r2p.runtime.topic import Topic
from tests.bench import hold, led, local, settle

if TYPE_CHECKING:
    from r2p.runtime.backpressure import Sink


def texts(records: r2p.Subscriber[Log]) -> list[str]:
    waiting = [Log.decode(sample.data).text for sample in records.queue]
    records.queue.clear()
    return waiting


@pytest.mark.virtual_time
async def test_the_rate_is_limited_and_the_next_record_says_what_is_missing() -> None:
    async with local() as module:
        node = module.start(hold)
        records = module.start(hold, name="watch").subscribe("log", Log, queue=1000)
        for number in range(LOG_RATE + 70):
            node.log.info("%d", number)
        assert texts(records) == [str(number) for number in range(LOG_RATE)]
        await settle(0.1)
        node.log.info("after a while")
        node.log.info("and on")
        assert texts(records) == ["(70 suppressed) after a while", "and on"]
        for _ in range(100):
            await settle(0.1)
            for _ in range(10):
                node.log.info("busy")
        assert len(texts(records)) == pytest.approx(LOG_RATE * 10, abs=LOG_RATE)


@pytest.mark.virtual_time
async def test_a_record_is_a_line_of_ascii() -> None:
    async with local() as module:
        node = module.start(hold)
        records = module.start(hold, name="watch").subscribe("log", Log, queue=1000)
        node.log.info("two\nlines")
        node.log.info("größer\0als")
        node.log.info("x" * 200)
        node.log.info("%s", {"a": 1})
        node.log.info("%(a)s", {"a": 1})
        node.log.log(300, "important")
        levels = [Log.decode(sample.data).level for sample in records.queue]
        assert texts(records) == ["two", "lines", "gr??er?als", "x" * 128, "{'a': 1}", "1", "important"]
        assert levels == [20] * 6 + [255]


@pytest.mark.virtual_time
async def test_bad_arguments_of_a_log_call_do_not_raise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("logging.raiseExceptions", False)
    async with local() as module:
        node = module.start(hold)
        records = module.start(hold, name="watch").subscribe("log", Log)
        node.log.info("%d", "no number")
        assert texts(records) == ["%d ('no number',)"]


@pytest.mark.virtual_time
async def test_a_full_log_queue_does_not_log_about_itself() -> None:
    async with local() as module:
        node = module.start(hold)
        records = module.start(hold, name="watch").subscribe("log", Log, queue=1)
        for number in range(10):
            node.log.info("%d", number)
        assert texts(records) == ["9"]
        assert records.lost == 9


@pytest.mark.virtual_time
async def test_a_node_that_logs_what_it_reads_from_the_log_is_slowed_down() -> None:
    count = 0

    async def parrot(node: r2p.Node) -> None:
        nonlocal count
        async for record in node.subscribe("log", Log):
            count += 1
            node.log.info("heard: %s", record.text)

    async with local() as module:
        module.start(parrot)
        node = module.start(hold)
        await settle()
        node.log.info("hello")
        await asyncio.sleep(10.0)
        assert count <= 2 * LOG_RATE


@pytest.mark.virtual_time
async def test_misses_go_to_the_log_topic() -> None:
    async with local() as module:
        node, other = module.start(hold), module.start(hold, name="watch")
        records = other.subscribe("log", Log)
        other.subscribe("leds", Led, queue=1)
        publisher = node.advertise("leds", Led)
        for number in range(3):
            publisher.publish_nowait(led(number))
        assert texts(records) == ["topic leds (watch): no room (missed 1, late 0 so far)"]


@pytest.mark.virtual_time
async def test_the_log_topic_can_be_remapped_and_ends_with_the_module() -> None:
    async with r2p.Module("PC1", via=[], remap={"log": "pc1_log"}) as module:
        node = module.start(hold)
        records = module.start(hold, name="watch").subscribe("pc1_log", Log)
        node.log.info("here")
        assert texts(records) == ["here"]
    node.log.info("nobody hears this")
    assert list(module.space.topics) == []


@pytest.mark.anyio
async def test_what_another_thread_logs_is_published_in_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    threads: set[int] = set()
    deliver = Topic.deliver

    def watched(topic: Topic, sample: r2p.Sample, own: object = None) -> list[Sink] | None:
        threads.add(threading.get_ident())
        return deliver(topic, sample, own)

    monkeypatch.setattr(Topic, "deliver", watched)
    async with r2p.Module("PC1", via=[], watchdog=False) as module:
        node = module.start(hold)
        records = module.start(hold, name="watch").subscribe("log", Log)
        await asyncio.to_thread(node.log.warning, "from a thread")
        assert (await records.fetch(30.0)).text == "from a thread"
    assert threads == {threading.get_ident()}


def test_a_thread_may_log_when_the_loop_is_closed() -> None:
    async def main() -> r2p.Node:
        async with r2p.Module("PC1", via=[], watchdog=False) as module:
            return module.start(hold)

    node = asyncio.run(main())
    thread = threading.Thread(target=node.log.warning, args=("too late",))
    thread.start()
    thread.join()
