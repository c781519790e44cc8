"""High bytes that no two topics share."""

from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import rtcan
from r2p.protocols.rtcan.topic_ids import TopicIdAllocator

SECOND = 1_000_000_000
LEASE = 300 * SECOND


def test_a_topic_keeps_its_byte_and_two_modules_pick_the_same() -> None:
    a, b = TopicIdAllocator(), TopicIdAllocator()
    high = a.pick("leds")
    assert high is not None
    assert high >= rtcan.FIRST_TOPIC
    assert a.pick("leds") == high == b.pick("leds")


@given(st.sets(st.text("abcdefgh_", min_size=1, max_size=16), max_size=60))
def test_no_two_topics_share_one(topics: set[str]) -> None:
    ours, theirs = TopicIdAllocator(), TopicIdAllocator()
    used: dict[int, str] = {}
    for n, topic in enumerate(sorted(topics)):
        mine, other = (ours, theirs) if n % 2 else (theirs, ours)
        high = mine.pick(topic)
        assert high is not None
        assert used.setdefault(high, topic) == topic
        other.on_announced(0, topic, rtcan.message_id(high, 10 + n % 2), 99)


def test_the_lower_id8_keeps_it() -> None:
    bytes_ = TopicIdAllocator()
    high = bytes_.pick("leds")
    assert high is not None
    assert bytes_.on_announced(0, "motor", rtcan.message_id(high, 30), 20) == []
    assert bytes_.on_announced(0, "leds", rtcan.message_id(high, 5), 20) == []
    assert bytes_.on_announced(0, "motor", rtcan.message_id(high, 10), 20) == ["leds"]
    bytes_.on_module_gone(5)
    again = bytes_.pick("leds")
    assert again not in (None, high)
    bytes_.drop("leds")
    bytes_.on_module_gone(10)
    bytes_.on_module_gone(30)
    assert bytes_.pick("leds") == high


def test_when_all_are_in_use() -> None:
    bytes_ = TopicIdAllocator()
    assert len({bytes_.pick(f"t{n}") for n in range(254)}) == 254
    assert bytes_.pick("one_more") is None
    assert bytes_.refused == {"one_more"}


def test_what_is_not_repeated_ends() -> None:
    bytes_ = TopicIdAllocator()
    for high in range(rtcan.FIRST_TOPIC, 256):
        bytes_.on_announced(0, f"t{high}", rtcan.message_id(high, 10), 20)
    assert bytes_.pick("leds") is None
    for high in range(3, 256):
        bytes_.on_announced(LEASE // 2, f"t{high}", rtcan.message_id(high, 10), 20)
    assert bytes_.retry(LEASE - 1) == []
    assert bytes_.retry(LEASE) == ["leds"]
    assert len(bytes_) == 253
    assert bytes_.pick("leds") == rtcan.FIRST_TOPIC
    assert bytes_.retry(2 * LEASE) == []
    assert len(bytes_) == 0


def test_a_lease_lasts_for_all_that_modules_on_a_slow_bus_have_to_say() -> None:
    bytes_ = TopicIdAllocator()
    bytes_.set_rate(2.0)
    bytes_.on_announced(0, "leds", 0x4210, 20)
    bytes_.retry(500 * SECOND)
    assert len(bytes_) == 1
    bytes_.retry(510 * SECOND)
    assert len(bytes_) == 0


def test_a_module_has_one_id_for_a_topic_and_one_topic_for_an_id() -> None:
    bytes_ = TopicIdAllocator()
    for number in range(3000):
        bytes_.on_announced(0, f"t{number}", rtcan.message_id(2 + number % 254, 10), 20)
    assert len(bytes_) == 254
    for number in range(254):
        bytes_.on_announced(0, "leds", rtcan.message_id(2 + number, 10), 20)
    assert len(bytes_) == 1
    assert len({bytes_.pick(f"ours{number}") for number in range(253)} - {None}) == 253
    bytes_.on_module_gone(10)
    assert len(bytes_) == 0


def test_all_publishers_of_a_topic_take_the_byte_of_the_one_with_the_lowest_id8() -> None:
    bytes_ = TopicIdAllocator()
    bytes_.on_announced(0, "leds", 0x4210, 30)
    assert bytes_.pick("leds") == 0x42
    assert bytes_.on_announced(0, "leds", 0x4328, 30) == []
    assert bytes_.on_announced(0, "leds", 0x4314, 30) == []  # not the lowest
    assert bytes_.on_announced(0, "leds", 0x440A, 30) == ["leds"]
    assert bytes_.pick("leds") == 0x44
    assert bytes_.on_announced(0, "motor", 0x4505, 30) == []
    assert bytes_.on_announced(0, "leds", 0x450A, 30) == []  # it will take another one: that is the motor's
    assert bytes_.on_announced(0, "leds", 0x460A, 30) == ["leds"]
    assert bytes_.pick("leds") == 0x46


def test_firmware_can_take_no_other() -> None:
    bytes_ = TopicIdAllocator()
    high = bytes_.pick("leds")
    assert high is not None
    assert bytes_.on_announced(0, "motor", rtcan.message_id(high, 0x30), 0x20, firmware=True) == ["leds"]
    assert bytes_.on_announced(0, "leds", 0x4210, 0x20) == []
    assert bytes_.pick("leds") == 0x42
    assert bytes_.on_announced(0, "leds", 0x5030, 0x20, firmware=True) == ["leds"]
    assert bytes_.pick("leds") == 0x50


@given(
    st.lists(
        st.tuples(st.sampled_from("abcd"), st.integers(0x200, 0xFFFF), st.integers(0, LEASE), st.booleans()),
        max_size=40,
    )
)
def test_whatever_is_announced(announced: list[tuple[str, int, int, bool]]) -> None:
    bytes_ = TopicIdAllocator()
    now = 0
    for topic, message, later, firmware in announced:
        now += later
        bytes_.pick("a")
        bytes_.on_announced(now, topic, message, 99, firmware=firmware)
        bytes_.on_module_gone(message + 1 & 0xFF)
        bytes_.retry(now)
    bytes_.retry(now + LEASE)
    assert len(bytes_) == 0
    assert bytes_.pick("b") is not None
