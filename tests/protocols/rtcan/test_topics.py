"""High bytes that no two topics share."""

from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import rtcan
from r2p.protocols.rtcan.topics import HighBytes


def test_a_topic_keeps_its_byte_and_two_modules_pick_the_same() -> None:
    a, b = HighBytes(), HighBytes()
    high = a.pick("leds")
    assert high is not None
    assert high >= rtcan.FIRST_TOPIC
    assert a.pick("leds") == high == b.pick("leds")


@given(st.sets(st.text("abcdefgh_", min_size=1, max_size=16), max_size=60))
def test_no_two_topics_share_one(topics: set[str]) -> None:
    ours, theirs = HighBytes(), HighBytes()
    used: dict[int, str] = {}
    for n, topic in enumerate(sorted(topics)):
        mine, other = (ours, theirs) if n % 2 else (theirs, ours)
        high = mine.pick(topic)
        assert high is not None
        assert used.setdefault(high, topic) == topic
        other.heard(topic, rtcan.message_id(high, 10 + n % 2), 99)


def test_the_lower_id8_keeps_it() -> None:
    bytes_ = HighBytes()
    high = bytes_.pick("leds")
    assert high is not None
    assert bytes_.heard("motor", rtcan.message_id(high, 30), 20) is None
    assert bytes_.heard("leds", rtcan.message_id(high, 5), 20) is None
    assert bytes_.heard("motor", rtcan.message_id(high, 10), 20) == "leds"
    again = bytes_.pick("leds")
    assert again not in (None, high)
    bytes_.drop("leds")
    bytes_.gone(10)
    bytes_.gone(30)
    assert bytes_.pick("leds") == high


def test_when_all_are_in_use() -> None:
    bytes_ = HighBytes()
    assert len({bytes_.pick(f"t{n}") for n in range(254)}) == 254
    assert bytes_.pick("one_more") is None
