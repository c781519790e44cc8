"""Two modules on a line that loses, repeats, delays and reorders: in the end they agree."""

from collections.abc import Iterable

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2p.codecs import management as m
from r2p.protocols.discovery.events import (
    TopicType,
)
from r2p.protocols.discovery.session import Discovery
from tests.protocols.discovery.wire import Line, S, Side, World

TOPICS = ("leds", "cmd", "odometry")
SHAPES = [TopicType(), TopicType(5), TopicType(5, b"\x01" * 8), TopicType(5, b"\x02" * 8), TopicType(8, b"\x03" * 8)]
RATE, BURST = 100.0, 8
SETTLED = 25.0
"""Seconds after the last loss: the longest lease, a round, a lease again, and the longest delay."""
LINGERS = 60.0
"""Seconds that a subscription lasts longer whose UNSUBSCRIBE was lost, while its module is there."""


class Wish(msgspec.Struct, frozen=True):
    """What one side has of one topic."""

    topic: str
    publishes: TopicType | None
    subscribes: TopicType | None


class Change(msgspec.Struct, frozen=True):
    """One side wishes something else, after some time (s)."""

    wait: float
    of_a: bool
    wish: Wish


shapes = st.none() | st.sampled_from(SHAPES[1:])
wishes = st.builds(Wish, st.sampled_from(TOPICS), shapes, st.none() | st.sampled_from(SHAPES))
changes = st.lists(st.builds(Change, st.floats(0, 3), st.booleans(), wishes), max_size=12)
lines = st.builds(Line, st.floats(0, 0.6), st.floats(0, 0.3), st.integers(0, S))


def wish_for(world: World, side: Side, wish: Wish) -> None:
    discovery, now = side.discovery, world.now
    if wish.publishes is None:
        world.do(side, discovery.withdraw(now, wish.topic))
    else:
        world.do(side, discovery.advertise(now, wish.topic, wish.publishes.size, wish.publishes.fingerprint))
    if wish.subscribes is None:
        world.do(side, discovery.unsubscribe(now, wish.topic))
    else:
        world.do(side, discovery.subscribe(now, wish.topic, wish.subscribes.size, 4, wish.subscribes.fingerprint))


def world_of(line: Line, seed: int) -> World:
    world = World(
        Discovery("A", 1, rate=RATE, burst=BURST),
        Discovery("B", 2, rate=RATE, burst=BURST, observer=True),
        seed,
    )
    world.line = line
    for side in (world.a, world.b):
        world.do(side, side.discovery.link_up(0))
    return world


def apply(world: World, steps: Iterable[Change]) -> dict[tuple[bool, str], Wish]:
    latest = {}
    for change in steps:
        world.run(change.wait)
        wish_for(world, world.a if change.of_a else world.b, change.wish)
        latest[change.of_a, change.wish.topic] = change.wish
    return latest


def check(
    publisher: Side, subscriber: Side, topic: str, publishes: TopicType | None, subscribes: TopicType | None
) -> None:
    """One topic in one direction, when all has been said."""
    flows = publishes is not None and subscribes is not None and publishes.fits(subscribes)
    assert (topic in publisher.attached) == flows
    if publishes is not None:  # a publisher of firmware never says good-bye, so what is open may stay open
        assert (topic in subscriber.opened) == flows
    if publishes is not None and subscribes is not None and not flows:
        assert (topic, m.ROLE_SUBSCRIBES) in publisher.mismatched
        assert (topic, m.ROLE_PUBLISHES) in subscriber.mismatched


def lingers(world: World, latest: dict[tuple[bool, str], Wish]) -> bool:
    """Return whether a side still sends what the other one no longer wants."""
    wanted = {key for key, wish in latest.items() if wish.subscribes is not None}
    sides = ((world.a, False), (world.b, True))
    return any((other_is_a, topic) not in wanted for side, other_is_a in sides for topic in side.attached)


def rate_kept(side: Side) -> bool:
    times = side.unsolicited
    return all(
        last - first + 1 <= BURST + (times[last] - times[first]) / S * RATE + 1e-6
        for first in range(len(times))
        for last in range(first, min(first + 100, len(times)))
    )


@settings(max_examples=60)
@given(lines, changes, st.integers(0, 1 << 32))
def test_they_agree_when_the_losses_stop(line: Line, steps: list[Change], seed: int) -> None:
    world = world_of(line, seed)
    latest = apply(world, steps)
    world.line = Line()
    world.run(SETTLED)
    if lingers(world, latest):
        world.run(LINGERS)
    for topic in TOPICS:
        a, b = (latest.get((of_a, topic), Wish(topic, None, None)) for of_a in (True, False))
        check(world.a, world.b, topic, a.publishes, b.subscribes)
        check(world.b, world.a, topic, b.publishes, a.subscribes)
    for side in (world.a, world.b):
        answers_lost = line.loss or line.delay
        assert not side.rejoined or side.believed_dead or answers_lost, "nobody restarted"
        assert rate_kept(side)


@settings(max_examples=30)
@given(lines, st.integers(0, 1 << 32), st.floats(0, 10))
def test_who_dies_in_silence_is_forgotten(line: Line, seed: int, life: float) -> None:
    world = world_of(line, seed)
    for topic in TOPICS:
        wish_for(world, world.a, Wish(topic, SHAPES[2], SHAPES[2]))
        wish_for(world, world.b, Wish(topic, SHAPES[2], SHAPES[2]))
    world.run(life)
    world.line = Line()
    world.run(3)
    assert world.a.attached == world.a.opened == set(TOPICS)
    world.b.alive = False
    world.run(12)
    assert not world.a.attached
    assert not world.a.opened
    assert not world.a.discovery.modules


@pytest.mark.parametrize("seed", range(5))
def test_who_restarts_joins_again(seed: int) -> None:
    """Once; if answers are lost perhaps more than once, but not for ever."""
    lossy = Line(loss=0.3, repeat=0.2, delay=S // 10)
    world = world_of(lossy, seed)
    wish_for(world, world.a, Wish("leds", SHAPES[2], None))
    wish_for(world, world.b, Wish("leds", None, SHAPES[2]))
    world.run(20)
    assert "leds" in world.a.attached
    for instance, line in enumerate((Line(repeat=0.2), lossy), start=3):
        world.a.rejoined.clear()
        world.line = line
        world.b.discovery = Discovery("B", instance, rate=RATE, burst=BURST, observer=True)
        world.do(world.b, world.b.discovery.link_up(world.now))
        wish_for(world, world.b, Wish("leds", None, SHAPES[2]))
        world.run(20)
        assert world.a.rejoined == ["leds"] if line is not lossy else world.a.rejoined
    world.line = Line()
    world.run(3)
    world.a.rejoined.clear()
    world.run(20)
    assert not world.a.rejoined


@settings(max_examples=100)
@given(st.lists(st.tuples(st.binary(min_size=30, max_size=33), st.integers(0, 4)), max_size=50), st.data())
def test_noise_is_harmless(noise: list[tuple[bytes, int]], data: st.DataObject) -> None:
    """Random bytes with likely endings: nothing raises, and afterwards an honest peer is served."""
    world = world_of(Line(), 0)
    wish_for(world, world.a, Wish("leds", SHAPES[2], SHAPES[2]))
    endings = st.sampled_from([0x11, 0x21, 0x22, 0x23, 0x31, 0x50, 0x51, 0x52, 0x53, 0x54, 0x7F])
    names = st.sampled_from([b"", b"A", b"B", b"leds", b"\x01A", b"\x01B", b"\x01\x01leds", b"\x01\x02leds"])
    for raw, source in noise:
        likely = (data.draw(names) + bytes(2) + raw)[:31].ljust(31, b"\0") + bytes((data.draw(endings),))
        for bad in (raw, likely):
            world.do(world.a, world.a.discovery.receive(world.now, bad, source or None), solicited=True)
        world.run(0.1)
    wish_for(world, world.b, Wish("leds", SHAPES[2], SHAPES[2]))
    world.run(2 * SETTLED)
    assert "leds" in world.b.opened
