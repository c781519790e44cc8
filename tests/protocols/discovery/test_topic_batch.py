"""Announcements that came together make the same tables as one after the other."""

from __future__ import annotations

from collections import Counter

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import management as m
from r2p.protocols.discovery.session import Discovery
from r2p.protocols.discovery.topic_batch import TopicBatch, split_topics
from r2p.units import SECOND

TOPICS = st.sampled_from(("pose", "leds", "imu", "mine", "asked"))
NODES = st.sampled_from(("a", "b"))
ROLES = st.sampled_from((m.ROLE_PUBLISHES, m.ROLE_SUBSCRIBES))
SIZES = st.sampled_from((4, 12, m.SIZE_VARIES | 40))
PRINTS = st.sampled_from((m.ANY_TYPE, b"12345678", b"abcdefgh"))
ANNOUNCEMENTS = st.one_of(
    st.builds(m.TypeInfo, ROLES, TOPICS, PRINTS, SIZES),
    st.builds(m.Advertise, TOPICS, SIZES),
    st.builds(m.SubscribeRequest, TOPICS, SIZES, st.just(1)),
    st.builds(m.Endpoint, ROLES, st.just(7), NODES, TOPICS),
)
OTHERS = st.one_of(
    st.builds(m.SubscribeResponse, TOPICS, SIZES, st.just(1)),
    st.builds(m.Endpoint, ROLES.map(lambda role: role | m.ROLE_GONE), st.just(7), NODES, TOPICS),
    st.builds(m.Endpoint, ROLES, st.just(8), NODES, TOPICS),
)
BATCHES = st.lists(st.tuples(st.lists(ANNOUNCEMENTS, max_size=8), st.lists(OTHERS, max_size=1)), max_size=4)


def made(*, is_known: bool, most: int) -> Discovery:
    discovery = Discovery("PC1", 1)
    discovery.limit_tables(most)
    discovery.set_lossless(0, addresses=True)
    discovery.link_up(0)
    discovery.advertise(0, "mine", 12)
    discovery.subscribe(0, "asked", 4)
    if is_known:
        discovery.receive(0, m.encode(m.Hello("BOT", 7, wire=m.WIRE_VERSION)), "bot")
    return discovery


def tables(discovery: Discovery) -> tuple[object, object]:
    return discovery.topics, discovery.endpoints


@given(BATCHES, st.booleans(), st.sampled_from((3, 100)))
def test_together_or_one_by_one(
    batches: list[tuple[list[m.Management], list[m.Management]]], is_known: bool, most: int
) -> None:
    one_by_one, together = made(is_known=is_known, most=most), made(is_known=is_known, most=most)
    for turn, (announcements, others) in enumerate(batches):
        now, messages = turn * SECOND, (*announcements, *others)
        events = [event for each in messages for event in one_by_one.receive(now, m.encode(each), "bot")]
        assert Counter(map(repr, together.receive_topics(now, TopicBatch(messages), "bot"))) == Counter(
            map(repr, events)
        )
        if most == 100:  # a full table forgets in the order in which entries came, which a batch may change
            assert tables(together) == tables(one_by_one)
        assert len(together.topics) <= most
        assert len(together.endpoints) <= most
    farewell = m.encode(m.Hello("BOT", 7, m.HELLO_LEAVING))
    for discovery in (one_by_one, together):
        discovery.receive(10 * SECOND, farewell, "bot")
    if most == 100:
        assert tables(together) == tables(one_by_one)


def test_entries_are_not_shared() -> None:
    batch = TopicBatch((m.TypeInfo(m.ROLE_PUBLISHES, "pose", b"12345678", 12), m.Advertise("pose", 12)))
    one, other = made(is_known=True, most=100), made(is_known=True, most=100)
    one.receive_topics(SECOND, batch, "bot")
    other.receive_topics(2 * SECOND, batch, "bot")
    assert one.topics["pose"] == msgspec.structs.replace(
        other.topics["pose"], advertised_at=SECOND, publisher_typed_at=SECOND
    )


def test_bad_bytes_among_them_go_one_by_one() -> None:
    hello, good = m.encode(m.Hello("BOT", 7)), m.encode(m.Advertise("pose", 12))
    first, batch = split_topics((hello, good))
    assert (first, batch.messages if batch is not None else None) == ((hello,), (m.Advertise("pose", 12),))
    assert split_topics((hello,)) == ((hello,), None)
    for bad in (good[:-1], b"\xff" * 31 + good[-1:], m.encode(m.Unsubscribe("pose", 7))):
        assert split_topics((hello, good, bad)) == ((hello, good, bad), None)
