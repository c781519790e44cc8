"""Subscribers that accept older types: in one module, and what can't be."""

from __future__ import annotations

from typing import Annotated, Any

import pytest

import r2p
from r2p.msg import Led
from tests.bench import hold, local


class Scan1(r2p.Message):
    """A type as it was."""

    ranges: Annotated[r2p.Array[r2p.f32], r2p.Max(10)] = r2p.Array()


class Scan2(r2p.Message):
    """As it is."""

    ranges: Annotated[r2p.Array[r2p.f32], r2p.Max(10)] = r2p.Array()
    tilt: r2p.f32 = 0.0


class Again(r2p.Message, name="tests/Scan1"):
    """Scan1 as another program defines it."""

    ranges: Annotated[tuple[r2p.f32, ...], r2p.Max(20)] = ()


def upgrade(old: Scan1) -> Scan2:
    assert type(old) is Scan1
    return Scan2(old.ranges, tilt=0.5)


def scans(module: r2p.Module, name: str = "sub") -> r2p.Subscriber[Scan2]:
    return module.start(hold, name=name).subscribe("scan", Scan2, accept={Scan1: upgrade})


@pytest.mark.virtual_time
@pytest.mark.parametrize("first", ["publisher", "subscriber"])
@pytest.mark.parametrize("sent", [Scan1(r2p.Array(bytearray(2))), Scan2(r2p.Array([1.0]), 0.5), Again((1.0, 2.0))])
async def test_in_one_module(sent: r2p.Message, first: str) -> None:
    async with local() as module:
        subscriber = scans(module) if first == "subscriber" else None
        publisher = module.start(hold, name="pub").advertise("scan", type(sent))
        subscriber = subscriber or scans(module)
        await publisher.publish(sent)
        received = await subscriber.fetch(1.0)
        assert (type(received), received.tilt, list(received.ranges)) == (Scan2, 0.5, list(sent.ranges))  # type: ignore[attr-defined]
        assert [type(sample.message) async for sample in one_sample(publisher, subscriber, sent)] == [Scan2]


async def one_sample(publisher: Any, subscriber: Any, sent: Any) -> Any:
    await publisher.publish(sent)
    async for sample in subscriber.samples():
        yield sample
        return


@pytest.mark.virtual_time
async def test_a_type_that_is_not_accepted_is_refused_in_a_module() -> None:
    async with local() as module:
        async with scans(module):
            with pytest.raises(r2p.TypeMismatch, match=r"scan is Led .* a subscriber of Scan2, Scan1 does not accept"):
                module.start(hold, name="pub").advertise("scan", Led)
        module.start(hold, name="leds").advertise("scan", Led)
        with pytest.raises(r2p.TypeMismatch, match=r"add it to its accept="):
            scans(module, "late")


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("cls", "accept", "error"),
    [
        (None, {Scan1: upgrade}, "accept= needs the type to which it converts"),
        (Scan2, {Scan1: Scan2()}, r"accept= takes a function for each type, as in \{Scan1: convert\}, not Scan2\("),
        (Scan2, {Scan2: upgrade}, "Scan2 in accept= has the same fields as Scan2: leave it out"),
        (Scan2, {Scan1: upgrade, Again: upgrade}, "Again in accept= has the same fields as Scan1: leave it out"),
        (Scan2, {int: upgrade}, "int is not a message class"),
    ],
)
async def test_options_that_can_not_be(cls: Any, accept: Any, error: str) -> None:
    async with local() as module:
        with pytest.raises(r2p.MessageError, match=error):
            module.start(hold).subscribe("scan", cls, accept=accept)
        assert "scan" not in module.space.topics


@pytest.mark.virtual_time
async def test_errors_of_the_function_are_the_readers() -> None:
    async with local() as module:
        node = module.start(hold, name="sub")
        functions: list[Any] = [lambda old: 1 / 0, lambda old: old]
        broken, wrong = (node.subscribe("scan", Scan2, accept={Scan1: each}) for each in functions)
        await module.start(hold, name="pub").advertise("scan", Scan1).publish(Scan1())
        with pytest.raises(ZeroDivisionError):
            await broken.fetch()
        with pytest.raises(r2p.MessageError, match="in accept= for Scan1 has to return a Scan2, not Scan1"):
            await wrong.fetch()
