"""Attachments to buses of this process: their ends, and what several threads do at once."""

import asyncio
import select
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import closing
from functools import partial

import pytest

import r2p.sim
from r2p.codecs.can_bits import AnyFrame, Frame
from r2p.errors import Closed, TransportError
from r2p.sim.buses import local
from r2p.sim.buses.attachment import AttachmentOptions, BusAttachment
from r2p.sim.buses.driver import BusDriver
from r2p.sim.buses.local import BusThread, LocalAttachment, attach_here, attach_to_thread
from r2p.sim.transport import SimCan

SOON = 20.0  # seconds
OPTIONS = AttachmentOptions()


@pytest.fixture
def loop() -> Iterator[asyncio.AbstractEventLoop]:
    with closing(asyncio.new_event_loop()) as loop:
        yield loop


async def attach_in_loop(channel: str) -> tuple[SimCan, LocalAttachment]:
    shared, attachment = r2p.sim.can_bus(channel), attach_here(channel, OPTIONS)
    assert attachment is not None
    return shared, attachment


def test_frames_that_wait_are_dropped_by_close() -> None:
    with closing(attach_to_thread("close", OPTIONS)) as a, closing(attach_to_thread("close", OPTIONS)) as b:
        for number in range(3):
            a.send(Frame(number, b""))
        assert b.receive(SOON)
        b.close()
        for call in (b.receive, b.flush, b.restart, b.fileno):
            with pytest.raises(Closed):
                call()
        with pytest.raises(Closed):
            b.set_filters([])


def test_an_attachment_is_closed_between_two_runs_of_its_loop(loop: asyncio.AbstractEventLoop) -> None:
    shared, attachment = loop.run_until_complete(attach_in_loop("runs"))
    assert shared.names == ["python-can"]
    attachment.close()  # at once: nothing runs the loop while this waits
    assert shared.names == []
    loop.run_until_complete(asyncio.sleep(0))


def test_a_thread_that_is_about_to_end_is_not_found(monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[BusAttachment | None] = []
    stop = BusThread.stop

    def attach_first(thread: BusThread) -> None:
        found.append(attach_here(thread.channel, OPTIONS))
        stop(thread)

    monkeypatch.setattr(BusThread, "stop", attach_first)
    attach_to_thread("ending", OPTIONS).close()
    assert found == [None]


async def block_while_another_thread_attaches(channel: str) -> None:
    shared = r2p.sim.can_bus(channel)
    errors: list[Exception] = []

    def attach() -> None:
        try:
            attach_here(channel, OPTIONS)
        except TransportError as error:
            errors.append(error)

    thread = threading.Thread(target=attach)
    thread.start()
    thread.join()  # the loop stands still
    assert "its event loop does not answer" in str(errors[0])
    await asyncio.sleep(0)
    assert shared.names == []


def test_an_attachment_that_its_loop_did_not_answer_is_not_made_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "_ANSWER_S", 0.01)
    asyncio.run(block_while_another_thread_attaches("blocked"))


async def close_while_the_loop_stands_still(channel: str, monkeypatch: pytest.MonkeyPatch) -> None:
    shared = r2p.sim.can_bus(channel)
    attachment = await asyncio.to_thread(attach_here, channel, OPTIONS)
    assert attachment is not None
    monkeypatch.setattr(local, "_ANSWER_S", 0.01)  # now: before, the loop answers, which may take longer
    thread = threading.Thread(target=attachment.close)
    thread.start()
    thread.join()
    assert shared.names == ["python-can"]
    await asyncio.sleep(0)
    assert shared.names == []


def test_a_node_leaves_as_soon_as_its_loop_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    asyncio.run(close_while_the_loop_stands_still("still", monkeypatch))


class AppendedMeanwhile(deque[AnyFrame]):
    """A queue that another thread puts a frame into while the first one is removed."""

    more: AnyFrame | None = Frame(9, b"")

    def popleft(self) -> AnyFrame:
        if self.more is not None:
            self.append(self.more)
            self.more = None
        return super().popleft()


async def flush_while_another_thread_sends(channel: str, *, starts: bool) -> list[int]:
    shared, a = await attach_in_loop(channel)
    b = attach_here(channel, OPTIONS)
    driver = shared.port("python-can")
    assert isinstance(driver, BusDriver)
    assert b
    with closing(a), closing(b):
        if not starts:
            b.send(Frame(99, b""))
            await asyncio.sleep(20e-6)
        for number in range(5):
            a.send(Frame(number, b""))
        driver.queue = AppendedMeanwhile(driver.queue)
        a.flush()
        a.send(Frame(10, b""))
        await asyncio.sleep(0.01)
        return [event.frame.id for event in iter(partial(b.receive, 0), None) if event.frame]


@pytest.mark.parametrize("starts", [False, True])
def test_flush_drops_what_waits_and_nothing_else(starts: bool) -> None:
    assert r2p.sim.run(flush_while_another_thread_sends("flush", starts=starts)) == [0] * starts + [9, 10]


def test_a_frame_that_comes_while_its_descriptor_is_cleared_is_seen() -> None:
    """The writer finds the descriptor set, just before the reader, who saw an empty queue, clears it."""
    ready, looks, frames = local._Readiness(), [0], list[int]()
    ready.set()

    def is_empty() -> bool:
        looks[0] += 1
        empty = not frames
        if looks[0] == 2:  # the last look before it is cleared
            frames.append(1)
            ready.set()
        return empty

    ready.clear_if(is_empty)
    assert select.select([ready.fileno()], [], [], 0)[0]
    frames.clear()
    ready.clear_if(is_empty)
    assert not select.select([ready.fileno()], [], [], 0)[0]
