"""What waits for a client that is too slow: by counts and bytes."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, cast

import pytest

from r2p.web.client import ANSWERS_BYTES, QUEUE_BYTES, WebClient
from tests.web.rig import FakeConnection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from websockets.asyncio.server import ServerConnection

pytestmark = pytest.mark.virtual_time

_LARGE = bytes(10_000)


@contextlib.asynccontextmanager
async def client_that_reads_nothing() -> AsyncIterator[tuple[WebClient, FakeConnection]]:
    connection = FakeConnection()
    connection.reads.clear()
    async with WebClient(cast("ServerConnection", connection)) as client:
        yield client, connection


async def test_the_oldest_messages_of_streams_are_dropped_and_counted() -> None:
    async with client_that_reads_nothing() as (client, connection):
        client.send("answer")
        for number in range(2000):
            client.send(number.to_bytes(2, "big") + _LARGE, "plot 1", amount=10)
        assert client._bytes <= QUEUE_BYTES
        connection.reads.set()
        await client.room()
        await asyncio.sleep(0)
        assert connection.sent[0] == "answer"
        numbers = [int.from_bytes(each[:2], "big") for each in connection.sent if isinstance(each, bytes)]
        assert numbers[-1] == 1999
        assert numbers == sorted(numbers)
        assert client.dropped == {"plot 1": 10 * (2000 - len(numbers))}


async def test_answers_and_streams_keep_their_order() -> None:
    async with client_that_reads_nothing() as (client, connection):
        for number in range(8):
            client.send(f"{number}", "plot 1" if number % 3 else None)
        connection.reads.set()
        await asyncio.sleep(1)
        assert connection.sent == [f"{number}" for number in range(8)]


async def test_what_is_sent_to_a_client_that_has_left_is_not_kept() -> None:
    async with client_that_reads_nothing() as (client, connection):
        client.send(_LARGE)
        await connection.close(1001, "")
        connection.reads.set()
        await asyncio.sleep(1)
        for _ in range(100):
            client.send(_LARGE)
        await client.room()
        assert not client._queue


async def test_a_text_counts_with_the_memory_that_it_takes() -> None:
    async with client_that_reads_nothing() as (client, _):
        client.send("\N{ROBOT FACE}" * 1000, "log")
        assert client._bytes >= 4000


async def test_a_client_that_does_not_read_its_answers_is_disconnected() -> None:
    async with client_that_reads_nothing() as (client, connection):
        for _ in range(ANSWERS_BYTES // len(_LARGE) + 1):
            client.send(_LARGE)
        await asyncio.sleep(0)
        assert connection.closed == (1008, "too slow: what it asked for does not fit the queue")
        client.send(_LARGE)
        assert not client._queue


async def test_of_messages_of_which_the_newest_counts_one_waits() -> None:
    async with client_that_reads_nothing() as (client, connection):
        await asyncio.sleep(0)
        for number in range(100):
            client.send_newest(f"{number}", "message leds")
        assert client.dropped == {"message leds": 99}
        connection.reads.set()
        await asyncio.sleep(1)
        client.send_newest("100", "message leds")
        await asyncio.sleep(1)
        assert connection.sent == ["0", "100"]
