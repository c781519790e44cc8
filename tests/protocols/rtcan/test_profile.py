"""Whose network it is, and how to speak among firmware."""

from collections import Counter

import pytest

from r2p.codecs import management, rtcan
from r2p.codecs.rtcan import Frame
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import EngineSettings, Profile, Received
from r2p.protocols.rtcan.management import QUIET, RateLimiter
from r2p.protocols.rtcan.network import Detector
from r2p.units import NEVER
from tests.protocols.rtcan.networks import current_cycle

MS = 1_000_000
STOP = management.encode(management.Stop("PC1"))


@pytest.mark.parametrize(
    ("wanted", "firmware", "found"),
    [
        (Profile.AUTO, False, Profile.RTCAN),
        (Profile.AUTO, True, Profile.FIRMWARE),
        (Profile.RTCAN, True, Profile.RTCAN),
        (Profile.FIRMWARE, False, Profile.FIRMWARE),
    ],
)
def test_what_is_found(wanted: Profile, firmware: bool, found: Profile) -> None:
    detector = Detector(wanted)
    detector.start()
    if firmware:
        detector.firmware_seen()
    detector.decide(synced=False)
    assert detector.profile is found
    detector.start()
    assert detector.profile is wanted
    detector.decide(synced=False)
    assert detector.profile is (Profile.RTCAN if wanted is Profile.AUTO else wanted)


def test_where_there_are_sync_frames_it_is_no_network_of_firmware_alone() -> None:
    detector = Detector(Profile.AUTO)
    detector.firmware_seen()
    detector.decide(synced=True)
    assert detector.profile is Profile.RTCAN


def test_it_speaks_when_it_is_quiet_and_a_random_time_later() -> None:
    limiter = RateLimiter(lambda below: below - 1, Counter())
    assert limiter.due == NEVER
    limiter.on_traffic(100 * MS)
    limiter.put(b"a")
    limiter.put(b"b")
    due = 100 * MS + QUIET + 20 * MS - 1
    assert limiter.due == due
    assert limiter.pop(due - 1) is None
    limiter.on_traffic(110 * MS)
    assert limiter.pop(due) is None
    assert limiter.pop(due + 10 * MS) == (b"a", None)
    assert limiter.due == due + 10 * MS + QUIET + 20 * MS - 1
    limiter.put(b"urgent", urgent=True)
    assert limiter.pop(limiter.due) == (b"urgent", None)
    limiter.put(b"c", handle="c")
    assert limiter.clear() == [None, "c"]
    assert limiter.due == NEVER


def test_it_is_bounded() -> None:
    counts: Counter[str] = Counter()
    limiter = RateLimiter(lambda below: 0, counts)
    for n in range(70):
        limiter.put(bytes([n]))
    assert counts == {"management dropped": 6}
    assert limiter.pop(QUIET) == (bytes([6]), None)


def hear(engine: Engine, now: int, laxities: list[int], payload: bytes = STOP, message: int = 0) -> list[bytes]:
    """A message of firmware, each of its frames with the laxity of that moment. Comes back: what was received."""
    received = []
    for laxity, (left, data) in zip(laxities, rtcan.fragments(payload), strict=True):
        now += 150_000
        actions = engine.receive(now, Frame(rtcan.encode_identifier(laxity, message, left), data), now)
        received += [each.payload for each in actions if isinstance(each, Received)]
    return received


def engine_of(profile: Profile) -> Engine:
    engine = Engine(EngineSettings(number=1 << 40, id8=10, profile=profile))
    engine.start(0)
    return engine


@pytest.mark.parametrize("laxities", [[50] * 4, [0] * 4, [2, 1, 1, 0], [0, 1, 1, 1], [63, 63, 63, 0], [1, 1, 0, 63]])
def test_management_that_ends_with_laxity_0_is_no_sync_among_firmware(laxities: list[int]) -> None:
    engine = engine_of(Profile.FIRMWARE)
    assert hear(engine, MS, laxities) == [STOP]
    assert hear(engine, 5 * MS, laxities) == [STOP]
    assert engine.reassembly.losses == {}


def test_a_topic_of_firmware_with_laxity_0_and_a_low_id_is_no_sync_either() -> None:
    engine = engine_of(Profile.FIRMWARE)
    engine.subscribe(0x0010, 5)
    assert hear(engine, MS, [0], b"12345", 0x0010) == [b"12345"]
    assert hear(engine, 2 * MS, [0], b"12345678", 0x0011) == []
    assert not engine.counts


def test_firmware_without_time_left_is_found_by_its_management() -> None:
    engine = engine_of(Profile.AUTO)
    at = 0
    while engine.profile is Profile.AUTO:
        hear(engine, at, [0] * 4)  # the last one ends just before it is decided
        at = engine.next_deadline() or 0
        engine.poll(at)
    assert engine.profile is Profile.FIRMWARE


def test_a_master_does_not_take_the_end_of_management_for_a_foreign_sync() -> None:
    engine = engine_of(Profile.RTCAN)
    hear(engine, MS, [0] * 4)
    assert current_cycle(engine) is None
    engine.receive(6 * MS, rtcan.encode_sync(256, 1), 6 * MS)
    assert current_cycle(engine) == 0


def test_urgent_ones_keep_their_order_and_are_the_last_to_be_dropped() -> None:
    counts: Counter[str] = Counter()
    limiter = RateLimiter(lambda below: 0, counts)
    limiter.put(b"later", handle="later")
    orders = [bytes([n]) for n in range(64)]
    assert [limiter.put(order, urgent=True, handle=order) for order in orders] == [*[None] * 63, "later"]
    assert limiter.put(b"late", handle="late") == "late"
    assert limiter.put(b"stop", urgent=True, handle="stop") == "stop"
    assert counts == {"management dropped": 3}
    sent = [limiter.pop(n * QUIET) for n in range(1, 65)]
    assert [each[0] for each in sent if each is not None] == orders
    limiter.put(b"later")
    limiter.put(b"stop", urgent=True)
    assert limiter.pop(100 * QUIET) == (b"stop", None)
