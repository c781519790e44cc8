"""Records of a recording are played at their instants, however the pace changes."""

import asyncio
import threading
from collections.abc import Iterator

import pytest

import r2p
import r2p.sim
from r2p.recording.pacing import PacedStream, Pacer
from r2p.units import MILLISECOND, SECOND

T0 = 1_700_000_000 * SECOND
RECORDS = [(T0 + i * 100 * MILLISECOND, i) for i in range(10)]


class _Stage:
    """A stream of records, and when each was played (ns after the start)."""

    def __init__(self, rate: float = 1.0) -> None:
        self.loop = asyncio.get_running_loop()
        self.pacer = Pacer(self.loop, rate=rate)
        self.stream = PacedStream[int](self.pacer, self._play, lambda _: 1)
        self.played: list[tuple[int, int]] = []
        self.began = 0

    def _play(self, _time: int, record: int) -> None:
        self.played.append((round(self.loop.time() * SECOND) - self.began, record))

    async def open(self) -> None:
        await self.stream.open(RECORDS)
        self.began = round(self.loop.time() * SECOND)
        self.pacer.begin(T0)


@pytest.mark.virtual_time
@pytest.mark.parametrize("rate", [0.5, 1.0, 3.0])
async def test_each_record_is_played_at_its_instant(rate: float) -> None:
    stage = _Stage(rate)
    await stage.open()
    await stage.stream.run()
    assert stage.played == [(round(i * 100 * MILLISECOND / rate), i) for i in range(10)]


@pytest.mark.virtual_time
async def test_a_pause_puts_off_all_that_follows() -> None:
    stage = _Stage()
    await stage.open()
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(stage.stream.run())
        await asyncio.sleep(0.25)
        stage.pacer.pause()
        await asyncio.sleep(10)
        assert stage.pacer.position == T0 + 250 * MILLISECOND
        assert [record for _, record in stage.played] == [0, 1, 2]
        stage.pacer.resume()
    assert stage.played[3] == (10_300 * MILLISECOND, 3)
    assert stage.played[-1] == (10_900 * MILLISECOND, 9)


@pytest.mark.virtual_time
async def test_steps_play_one_record_of_all_streams_each() -> None:
    stage, other = _Stage(), []
    late = PacedStream[str](stage.pacer, lambda _, text: other.append(text), len)
    await stage.open()
    await late.open([(T0 + 150 * MILLISECOND, "a"), (T0 + 10 * SECOND, "b")])
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(stage.stream.run())
        tasks.create_task(late.run())
        stage.pacer.pause()
        for _ in range(4):
            stage.pacer.step()
        assert ([record for _, record in stage.played], other) == ([0, 1, 2], ["a"])
        assert stage.pacer.position == T0 + 200 * MILLISECOND
        for _ in range(8):
            stage.pacer.step()
        assert (len(stage.played), other) == (10, ["a", "b"])  # which is the end, also while it is paused


@pytest.mark.virtual_time
async def test_the_rate_changes_while_it_is_played() -> None:
    stage = _Stage()
    await stage.open()
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(stage.stream.run())
        await asyncio.sleep(0.45)
        stage.pacer.rate = 0.5
        with pytest.raises(r2p.MessageError, match=r"the rate is 0\.001 to 10000 times"):
            stage.pacer.rate = 0
    assert stage.played[4:6] == [(400 * MILLISECOND, 4), (550 * MILLISECOND, 5)]


@pytest.mark.virtual_time
async def test_what_playing_raises_ends_it() -> None:
    def refuse(_time: int, record: int) -> None:
        raise r2p.Error(f"record {record}")

    stage = _Stage()
    stream = PacedStream[int](stage.pacer, refuse, lambda _: 1)
    await stream.open(RECORDS)
    stage.pacer.begin(T0)
    with pytest.raises(r2p.Error, match="record 0"):
        await stream.run()


def _broken() -> Iterator[tuple[int, int]]:
    yield from RECORDS[:3]
    raise r2p.Error("the file is cut off")


@pytest.mark.parametrize("virtual", [True, False])
def test_what_reading_raises_comes_when_all_before_it_was_played(virtual: bool) -> None:
    async def main() -> list[int]:
        played: list[int] = []
        pacer = Pacer(asyncio.get_running_loop(), rate=1000)
        stream = PacedStream[int](pacer, lambda _, record: played.append(record), lambda _: 1)
        await stream.open(_broken())
        pacer.begin(T0)
        with pytest.raises(r2p.Error, match="cut off"):
            await stream.run()
        return played

    assert (r2p.sim.run(main) if virtual else asyncio.run(main())) == [0, 1, 2]


def test_only_so_many_bytes_are_read_ahead_and_the_end_stops_reading() -> None:
    read: list[int] = []
    full = threading.Event()

    def records() -> Iterator[tuple[int, bytes]]:
        for i in range(1 << 30):
            read.append(i)
            if i == 31:
                full.set()
            yield T0 + i, bytes(1 << 20)

    async def main() -> None:
        pacer = Pacer(asyncio.get_running_loop())
        pacer.pause()
        stream = PacedStream[bytes](pacer, lambda _, record: None, len)
        await stream.open(records())
        run = asyncio.create_task(stream.run())
        await asyncio.to_thread(full.wait)
        run.cancel()
        with pytest.raises(asyncio.CancelledError):
            await run

    asyncio.run(main())
    assert 32 <= len(read) <= 40
    assert "r2p-bag-reader" not in [each.name for each in threading.enumerate()]
