"""`sim:`: modules on a simulated CAN bus, by URL and in code, under virtual time and paced."""

import asyncio
import hashlib
import itertools
import random

import pytest

import r2p
import r2p.sim
from r2p.clock import clock_of
from r2p.msg import PWM2, Led
from r2p.sim.can import FrameRecord
from r2p.sim.clocks import VirtualClock
from r2p.sim.loop import VirtualLoop
from r2p.testing.network import node_in
from r2p.transports.url import open_transport


def module(name: str, via: str) -> r2p.Module:
    return r2p.Module(name, via=via, watchdog=False)


@pytest.mark.virtual_time
async def test_modules_that_name_one_bus_are_on_it() -> None:
    async with (
        module("A", "sim:lab") as a,
        module("B", "sim:lab") as b,
        module("C", "sim:other") as c,
        node_in(a) as alice,
        node_in(b) as bob,
        node_in(c) as carol,
    ):
        publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
        apart = carol.subscribe("leds", Led)
        await publisher.wait_subscriber()
        await publisher.publish(Led(led=1))
        assert await subscriber.fetch(timeout=1.0) == Led(led=1)
        assert not apart.queue
        lab = r2p.sim.can_bus("lab")
        assert lab.bus.statistics.by_node["A"].frames
        assert "C" not in lab.bus.statistics.by_node


@pytest.mark.virtual_time
async def test_options_of_the_node() -> None:
    async with module("A", "sim:lab,drift=30,offset=5ms,latency=10us,jitter=2us,loss=0.5,one_shot=0,id=9"):
        node = r2p.sim.can_bus("lab").port("A").controller.node
        assert (node.drift_ppm, node.offset, node.loss, node.one_shot) == (30.0, 5_000_000, 0.5, False)
        assert (node.transmit.nominal, node.transmit.jitter, node.receive.nominal) == (10_000, 2_000, 10_000)


@pytest.mark.virtual_time
async def test_options_of_the_network() -> None:
    via = "sim:lab,bitrate=500000,slots=10,cycle=10ms,priority=3"
    async with module("A", via) as a, module("B", via) as b, node_in(a) as alice, node_in(b) as bob:
        publisher = alice.advertise("pwm", PWM2, r2p.Periodic(0.005, PWM2))
        await publisher.ready(5.0)
        assert publisher.period == 0.005
        assert publisher.guarantees["sim:lab"].startswith("a slot every 5 slots (5 ms)")
        assert await bob.subscribe("pwm", PWM2).fetch(timeout=1.0) == PWM2()


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("sim:", "give the bus a name"),
        ("sim:lab,wheel=1", "it knows: .*drift"),
        ("sim:lab,id=0", "1 to 255"),
        ("sim:lab,priority=256", "0 to 255"),
        ("sim:lab,slots=64,cycle=5ms", "too short"),
        ("sim:lab,bitrate=3000000", "whole nanoseconds"),
        ("sim:lab,profile=best", "auto, rtcan, firmware-2014"),
        ("sim:lab,one_shot=yes", "0 or 1"),
        ("sim:lab,loss=2", "between 0 and 1"),
        ("rtcan:", "rtcan:can0"),
        ("rtcan:can0,drift=3", "no option 'drift'"),
    ],
)
def test_what_a_url_can_not_be(url: str, text: str) -> None:
    with pytest.raises(r2p.TransportError, match=text):
        open_transport(url)


@pytest.mark.virtual_time
async def test_one_bus_has_one_bit_rate() -> None:
    async with module("A", "sim:lab"):
        with pytest.raises(r2p.TransportError, match="1000000 bit/s, not 500000"):
            async with module("B", "sim:lab,bitrate=500000,cycle=20ms"):
                pass


@pytest.mark.virtual_time
async def test_a_module_that_comes_again_is_the_same_node() -> None:
    lab = r2p.sim.can_bus("lab")
    for _ in range(3):
        async with module("A", "sim:lab") as a:
            while not a.links[0].up:  # noqa: ASYNC110 - under virtual time
                await asyncio.sleep(0.01)
            assert lab.port("A").controller.name == "A"
    async with module("A", "sim:lab"), module("A", "sim:lab"):
        assert lab.port("A'").controller.name == "A'"


@pytest.mark.virtual_time
async def test_a_module_that_closes_gives_its_slots_back_and_says_good_bye() -> None:
    async with module("B", "sim:lab,priority=5") as b:
        async with module("A", "sim:lab") as a, node_in(a) as alice:
            publisher = alice.advertise("pwm", PWM2, r2p.Periodic(0.005, PWM2))
            await publisher.ready(5.0)
            link = b.links[0]
            await asyncio.sleep(0.1)
            assert link.engine.cycle.mask != 1  # type: ignore[attr-defined]
        await asyncio.sleep(0.05)
        assert link.engine.cycle.mask == 1  # type: ignore[attr-defined]
        assert [view.name for view in b.network.modules()] == ["B"]


def _course(seed: int) -> str:
    """All that happens on a bus in a while, as one number."""
    digest = hashlib.sha256()

    async def main() -> None:
        lab = r2p.sim.can_bus("lab", noise=0.01)

        def watch(record: FrameRecord) -> None:
            digest.update(repr(record).encode())

        lab.bus.observers.append(watch)
        options = "latency=5us,jitter=3us"
        async with (
            module("A", f"sim:lab,drift=30,{options}") as a,
            module("B", f"sim:lab,drift=-20,{options}") as b,
            node_in(a) as alice,
            node_in(b) as bob,
        ):
            bob.subscribe("pwm", PWM2, lossy=True)
            alice.advertise("pwm", PWM2, r2p.Periodic(0.002, PWM2))
            await asyncio.sleep(4.0)

    r2p.sim.run(main, seed=seed)
    return digest.hexdigest()


def test_one_seed_one_course_of_events() -> None:
    assert _course(1) == _course(1)
    assert _course(1) != _course(2)


class WallClock(VirtualClock):
    """A clock that is not virtual, and that advances each time it is read."""

    virtual = False

    def __init__(self, numbers: random.Random) -> None:
        super().__init__()
        self._numbers = numbers

    def now(self) -> int:
        self.elapsed += self._numbers.randrange(300_000)
        return super().now()

    def monotonic(self) -> int:
        self.elapsed += self._numbers.randrange(300_000)
        return super().monotonic()


class BusyLoop(VirtualLoop):
    """An ordinary loop on a busy computer: whenever it has slept, it wakes up late."""

    LATEST = 45_000_000  # ns: more than four cycles

    def __init__(self) -> None:
        super().__init__(seed=1)
        self.clock = WallClock(self.random)

    def _idle(self) -> float | None:
        wait = super()._idle()
        self.clock.elapsed += self.random.randrange(self.LATEST)
        return wait


def test_paced_to_real_time() -> None:
    """On an ordinary loop events are carried out late, but their instants on the bus are exact."""
    starts: list[int] = []
    late: list[int] = []

    def observe(record: FrameRecord) -> None:
        late.append(clock_of().monotonic() - record.end)
        if record.frame.id < 1 << 15:
            starts.append(record.start)

    async def main() -> None:
        lab = r2p.sim.can_bus("lab", seed=1)
        lab.bus.observers.append(observe)
        async with module("A", "sim:lab") as a, module("B", "sim:lab") as b, node_in(a) as alice, node_in(b) as bob:
            publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
            await publisher.wait_subscriber()
            while len(starts) < 100:
                await publisher.publish(Led(led=len(starts)))
                sample = await anext(subscriber.samples())
                assert sample.stamp <= clock_of().now()
            assert {after - before for before, after in itertools.pairwise(starts)} == {60 * 166_000}
            assert not a.links[0].losses

    with asyncio.Runner(loop_factory=BusyLoop) as runner:
        runner.run(main())
    assert min(late) >= 0
    assert max(late) > 3 * 60 * 166_000
