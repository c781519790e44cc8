"""What type checkers see of the API: mypy and pyright check these lines; an ignore that nothing needs is an error.

They run as well, so that what the checkers believe is what there is.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, Any, assert_type

import pytest

import r2p
from r2p.msg import Encoder, Led
from r2p.recording.samples import SampleWriter
from r2p.recording.writer import BagWriter

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


class Lamp(r2p.Message):
    """The layout of Led, as another program may have it."""

    led: r2p.u32 = 0
    value: r2p.u8 = 0


async def talk(node: r2p.Node) -> None:
    leds = node.subscribe("leds", Led)
    assert_type(leds, r2p.Subscriber[Led])
    raw = node.subscribe("leds", None)
    assert_type(raw, r2p.Subscriber[bytes])
    lamps = node.advertise("leds", Lamp)
    assert_type(lamps, r2p.Publisher[Lamp])
    assert_type(node.advertise("a", Led, r2p.Sporadic(1.0)), r2p.SporadicPublisher[Led])
    assert_type(node.advertise("b", Led, r2p.Periodic(1.0, Led)), r2p.PeriodicPublisher[Led])
    for _ in range(2):
        await lamps.publish(Lamp(led=3))
    async for sample in leds.samples():
        assert_type(sample, r2p.Sample[Led])
        assert_type(sample.message, Led)
        assert sample.message == Led(led=3)  # of the subscriber's class, not of the publisher's
        break
    assert_type(await leds.fetch(timeout=1.0), Led)
    async for packed in raw.samples():
        assert_type(packed.message, r2p.Message | None)
        assert packed.message == Lamp(led=3)
        break
    assert_type(await raw.fetch(timeout=1.0), bytes)


class Dim(r2p.Service):
    class Request(r2p.Message):
        level: r2p.u8 = 0

    class Response(r2p.Message):
        before: r2p.u8 = 0


async def dim(request: Dim.Request) -> Dim.Response:
    return Dim.Response(before=request.level)


async def ask(node: r2p.Node) -> None:
    assert_type(node.serve("dim", Dim, dim), r2p.ServiceServer[Dim.Request, Dim.Response])
    one, two = node.client("dim", Dim), node.client("dim", Dim.Request, Dim.Response)
    assert_type(one, r2p.ServiceClient[Dim.Request, Dim.Response])
    assert_type(two, r2p.ServiceClient[Dim.Request, Dim.Response])
    assert_type(await one.call(Dim.Request(level=3), timeout=2.0), Dim.Response)

    @node.service("undim", Dim)
    async def undim(request: Dim.Request) -> Dim.Response:
        return Dim.Response(before=request.level)

    assert_type(await undim(Dim.Request()), Dim.Response)
    with pytest.raises(r2p.MessageError):
        await one.call(Dim.Response())  # type: ignore[arg-type]
    with pytest.raises(r2p.MessageError):
        node.client("lamp", Lamp)  # type: ignore[arg-type]


class Gear(enum.Enum):
    LOW = 1
    HIGH = 2


async def tune(node: r2p.Node) -> None:
    kp = node.parameter("kp", 0.5, min=0, max=10.0, check=lambda value: None if value else "not 0")
    assert_type(kp, r2p.Parameter[float])
    assert_type(kp.value, float)
    assert_type(node.parameter("enabled", True), r2p.Parameter[bool])
    assert_type(node.parameter("steps", 3), r2p.Parameter[int])
    assert_type(node.parameter("label", "left"), r2p.Parameter[str])
    assert_type(node.parameter("gear", Gear.LOW), r2p.Parameter[Gear])
    assert_type(node.parameter("bias", (0.0, 1.0)), r2p.Parameter[tuple[float, float]])
    kp.set(2)
    assert (kp.value, type(kp.value)) == (2.0, float)

    def above(value: float, values: Mapping[str, Any]) -> str | None:
        return None if value > values["kp"] else "too low"

    node.parameter("limit", 3.0, check=above, on_change=lambda value: assert_type(value, float))
    with pytest.raises(r2p.ParameterError):
        kp.set("fast")  # type: ignore[arg-type]
    with pytest.raises(r2p.ParameterError):
        node.parameter("list", [1.0])  # type: ignore[type-var]
    with pytest.raises(AttributeError):
        kp.value = 1.0  # type: ignore[misc]


async def mistake(node: r2p.Node) -> None:
    with pytest.raises(r2p.MessageError):
        node.subscribe("leds", int)  # type: ignore[type-var]
    with pytest.raises(r2p.MessageError):
        await node.advertise("encoder", Encoder).publish(Led())  # type: ignore[arg-type]


def last_stamp(samples: list[r2p.Sample]) -> int:
    """A sample without a type in brackets is one of any message."""
    assert_type(samples[0].message, r2p.Message | None)
    return samples[-1].stamp


@pytest.mark.virtual_time
async def test_what_type_checkers_see_is_what_there_is() -> None:
    async with r2p.Module("PC1", via=[]) as module:
        module.start(talk)
        module.start(ask)
        module.start(tune)
        module.start(mistake)
        await module.wait()
    assert last_stamp([r2p.Sample(b"", r2p.Source(), 5)]) == 5


def test_samples_of_a_bag_are_typed(tmp_path: Path) -> None:
    with (tmp_path / "drive.mcap").open("wb") as file:
        writer = BagWriter(file)
        SampleWriter(writer).write("leds", r2p.Sample(Led(3).encode(), r2p.Source("IMU"), 5), Led, 6)
        writer.finish()
    with r2p.Bag(tmp_path / "drive.mcap") as bag:
        for sample in bag.samples("leds", Lamp):
            assert_type(sample, r2p.Sample[Lamp])
            assert sample.message == Lamp(led=3)
        for untyped in bag.samples("leds"):
            assert_type(untyped, r2p.Sample[Any])
            assert untyped.message == Led(led=3)
