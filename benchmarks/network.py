"""Two processes over TCP on loopback, against bare asyncio streams that exchange lines."""

import asyncio
import time
from collections.abc import Callable, Coroutine, Iterator
from multiprocessing.connection import Connection
from typing import Any

import r2p
from benchmarks import ends
from benchmarks.ends import Result
from benchmarks.loops import run_on
from benchmarks.processes import process
from benchmarks.table import Row, p50_p99, rate
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse

MESSAGES = 200_000
ROUNDS = 10_000


class Eight(r2p.Message):
    """32 bytes."""

    values: tuple[r2p.f32, r2p.f32, r2p.f32, r2p.f32, r2p.f32, r2p.f32, r2p.f32, r2p.f32] = (0.0,) * 8


MESSAGE = Eight(values=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0))
LOAD = ends.Load(MESSAGE, MESSAGES, ROUNDS)
LINE = b"@00000000:07numbers:20" + bytes(32).hex().encode() + b":00\r\n"


async def _serve(pipe: Connection) -> None:
    transport = TcpListenTransport(parse("tcp-listen:127.0.0.1:0"))
    await ends.serve(r2p.Module("SERVER", via=[transport], watchdog=False), LOAD, pipe, lambda: transport.port)


async def _serve_lines(pipe: Connection) -> None:
    """The bare other process: counts lines, then echoes them."""

    async def handle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        started = 0.0
        for _ in range(MESSAGES):
            await reader.readline()
            started = started or time.perf_counter()
        pipe.send((MESSAGES, 0, time.perf_counter() - started))
        while line := await reader.readline():
            writer.write(line)

    server = await asyncio.start_server(handle, "127.0.0.1", 0)
    pipe.send(server.sockets[0].getsockname()[1])
    await server.serve_forever()


async def _drive(port: int, pipe: Connection) -> Result:
    return await ends.drive(r2p.Module("CLIENT", via=f"tcp:127.0.0.1:{port}", watchdog=False), LOAD, pipe)


async def _drive_lines(port: int, pipe: Connection) -> Result:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    for _ in range(MESSAGES):
        writer.write(LINE)
        await writer.drain()
    received, lost, seconds = await asyncio.to_thread(pipe.recv)
    trips = []
    for _ in range(ROUNDS):
        at = time.perf_counter()
        writer.write(LINE)
        await reader.readline()
        trips.append(time.perf_counter() - at)
    writer.close()
    return received / seconds, lost, trips


Server = Callable[[Connection], Coroutine[Any, Any, None]]
Driver = Callable[[int, Connection], Coroutine[Any, Any, Result]]


def _process(pipe: Connection, serve: Server, loop: str) -> None:
    run_on(loop, serve(pipe))


def _both(serve: Server, drive: Driver, loop: str) -> Result:
    with process(_process, serve, loop) as server:
        return run_on(loop, drive(server.recv(), server))


def rows() -> Iterator[Row]:
    bare, _, bare_trips = _both(_serve_lines, _drive_lines, "asyncio")
    _, _, fast_trips = _both(_serve_lines, _drive_lines, "uvloop")
    ours, lost, trips = _both(_serve, _drive, "uvloop")
    yield Row(
        "two processes over TCP, typed, 32 bytes",
        f"{rate(ours)}, {lost} lost",
        f"bare asyncio lines {rate(bare)}: {ours / bare:.2f}x",
        "80 k/s, none lost",
        ours >= 80e3 and not lost,
    )
    (median, worst), (bare_median, _), (fast_median, _) = p50_p99(trips), p50_p99(bare_trips), p50_p99(fast_trips)
    yield Row(
        "round trip over TCP, typed, 32 bytes, p50, p99",
        f"{median:.0f} us, {worst:.0f} us",
        f"bare echo, asyncio {bare_median:.0f} us: {median / bare_median:.1f}x, uvloop {fast_median:.0f} us",
        "p50 within 2x",
        median <= 2 * bare_median,
    )
