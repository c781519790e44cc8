"""Whose network it is, and how to speak among firmware."""

from collections import Counter

import pytest

from r2p.protocols.rtcan.events import NEVER, Profile
from r2p.protocols.rtcan.profile import QUIET, Detector, Pacer

MS = 1_000_000


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
        detector.firmware_heard()
    detector.decide(synced=False)
    assert detector.profile is found
    detector.start()
    assert detector.profile is wanted
    detector.decide(synced=False)
    assert detector.profile is (Profile.RTCAN if wanted is Profile.AUTO else wanted)


def test_where_there_are_sync_frames_it_is_no_network_of_firmware_alone() -> None:
    detector = Detector(Profile.AUTO)
    detector.firmware_heard()
    detector.decide(synced=True)
    assert detector.profile is Profile.RTCAN


def test_it_speaks_when_it_is_quiet_and_a_random_time_later() -> None:
    pacer = Pacer(lambda below: below - 1, Counter())
    assert pacer.due == NEVER
    pacer.traffic(100 * MS)
    pacer.put(b"a")
    pacer.put(b"b")
    due = 100 * MS + QUIET + 20 * MS - 1
    assert pacer.due == due
    assert pacer.pop(due - 1) is None
    pacer.traffic(110 * MS)
    assert pacer.pop(due) is None
    assert pacer.pop(due + 10 * MS) == (b"a", None)
    assert pacer.due == due + 10 * MS + QUIET + 20 * MS - 1
    pacer.put(b"urgent", urgent=True)
    assert pacer.pop(pacer.due) == (b"urgent", None)
    pacer.put(b"c", handle="c")
    assert pacer.clear() == [None, "c"]
    assert pacer.due == NEVER


def test_it_is_bounded() -> None:
    counts: Counter[str] = Counter()
    pacer = Pacer(lambda below: 0, counts)
    for n in range(70):
        pacer.put(bytes([n]))
    assert counts == {"management dropped": 6}
    assert pacer.pop(QUIET) == (bytes([6]), None)
