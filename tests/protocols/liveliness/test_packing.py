"""Several tokens share a key: which keys come and go as tokens do, and what others make of them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import liveliness
from r2p.codecs.liveliness import ModuleToken, TopicToken
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.discovery.events import Declare, Event, SubscriberJoined, SubscriberLeft, Undeclare
from r2p.protocols.liveliness.packing import TOKENS_OF_PACK, TokenPacker
from r2p.protocols.liveliness.session import LivelinessDiscovery

TOKENS = [liveliness.encode(TopicToken(7, ROLE_PUBLISHES, f"topic{number}", 7, "node")) for number in range(100)]
LONGEST = liveliness.encode(TopicToken(0xFFFFFFFF, ROLE_SUBSCRIBES, "t" * 255, 0xFFFFFFFF, "n" * 64, 255, 1 << 26))


def keys(events: list[Declare | Undeclare], declared: set[str]) -> set[str]:
    """Return the keys after these changes of them; each must be one."""
    for event in events:
        assert (event.key in declared) == isinstance(event, Undeclare)
        declared = declared ^ {event.key}
    return declared


def tokens_in(declared: set[str]) -> list[str]:
    return sorted(token for key in declared for token in liveliness.unpack(key))


@given(st.lists(st.tuples(st.sampled_from(TOKENS), st.booleans()), max_size=300))
def test_each_token_has_one_key(steps: list[tuple[str, bool]]) -> None:
    packer, there, declared = TokenPacker(), set[str](), set[str]()
    for token, looks in steps:
        (packer.remove if token in there else packer.add)(token)
        there ^= {token}
        if looks:
            declared = keys(packer.pop_changes(), declared)
            assert tokens_in(declared) == sorted(there)
            assert not packer.has_changes
    assert not keys(packer.withdraw_all(), declared)
    assert tokens_in(keys(packer.pop_changes(), set())) == sorted(there)


def test_what_is_taken_out_and_added_again_at_once_has_been_there_all_the_time() -> None:
    packer = TokenPacker()
    packer.add(TOKENS[0])
    packer.pop_changes()
    packer.remove(TOKENS[0])
    packer.add(TOKENS[0])
    assert packer.pop_changes() == []


def test_what_changes_at_once_is_one_key_and_room_is_used_again() -> None:
    packer = TokenPacker()
    for token in TOKENS:
        packer.add(token)
    declared = keys(packer.pop_changes(), set())
    assert len(declared) == -(-len(TOKENS) // TOKENS_OF_PACK)
    for token in TOKENS[::2]:
        packer.remove(token)
    for token in TOKENS[::2]:
        packer.add(token)
    assert len(keys(packer.pop_changes(), declared)) == len(declared)


def test_new_keys_are_declared_before_others_end() -> None:
    packer = TokenPacker()
    for token in TOKENS[:40]:
        packer.add(token)
    packer.pop_changes()
    for token in (TOKENS[3], TOKENS[35]):
        packer.remove(token)
    assert [type(event) for event in packer.pop_changes()] == [Declare, Declare, Undeclare, Undeclare]


def test_a_full_pack_of_the_longest_tokens_is_short_enough() -> None:
    packed = liveliness.pack([LONGEST] * liveliness.PACK_MAX)
    assert liveliness.unpack(packed) == [LONGEST] * liveliness.PACK_MAX
    assert TOKENS_OF_PACK <= liveliness.PACK_MAX


@given(st.permutations([0, 1, 2]), st.permutations([0, 1, 2]))
def test_tokens_that_several_keys_have_stay_until_the_last_one_goes(come: list[int], go: list[int]) -> None:
    """That is how a pack changes: the new key comes before the old one goes."""
    wants = [liveliness.encode(TopicToken(7, ROLE_SUBSCRIBES, topic, 7, "node", window=8)) for topic in ("a", "b", "c")]
    packs = [liveliness.pack(wants[:2]), liveliness.pack(wants[1:]), wants[1]]
    events: list[Event] = []
    module = LivelinessDiscovery("A", 1)
    events += module.link_up(0)
    for topic in "abc":
        events += module.advertise(0, topic, 5)
    for number in come:
        events += module.appeared(0, packs[number])
    assert sorted(each.topic for each in events if isinstance(each, SubscriberJoined)) == ["a", "b", "c"]
    for count, number in enumerate(go):
        assert ("b" in module.topics) == (count < 3)
        events = module.disappeared(0, packs[number])
        assert [each.topic for each in events if isinstance(each, SubscriberLeft)].count("b") == (count == 2)
    assert not module.topics
    assert not module.endpoints


def test_a_pack_without_room_is_refused_as_a_whole_and_known_tokens_take_none() -> None:
    module = LivelinessDiscovery("A", 1, tokens_max=10)
    module.link_up(0)
    module.appeared(0, liveliness.pack(TOKENS[:8]))
    module.appeared(0, liveliness.pack(TOKENS[8:12]))
    assert module.counts == {"too many tokens": 4}
    assert len(module.topics) == 8
    module.appeared(0, liveliness.pack(TOKENS[:10]))
    assert len(module.topics) == 10
    assert module.counts == {"too many tokens": 4}


@pytest.mark.parametrize("modules", [5, 20])
def test_keys_grow_with_modules_and_not_with_topics(modules: int) -> None:
    """Each module declares two keys for 30 topics, so that N modules pass on 2 N squared of them, instead of 31."""
    told, known = 0, [LivelinessDiscovery(f"M{number}", number + 1) for number in range(modules)]
    for number, module in enumerate(known):
        events = module.link_up(0)
        for topic in range(30):
            events += module.advertise(0, f"m{number}/t{topic}", 5)
        events += module.poll(0)
        declared = keys([each for each in events if isinstance(each, Declare | Undeclare)], set())
        for other in known:
            for key in declared:
                other.appeared(0, key)
                told += 1
    assert told == 2 * modules**2
    assert all(len(each.topics) == 30 * (modules - 1) for each in known)
    assert all(len(each.modules) == modules - 1 for each in known)


def test_a_gateway_passes_a_change_on_by_one_key() -> None:
    """Not by a look at all that it has passed on before."""
    gateway = LivelinessDiscovery("GW", 1)
    gateway.link_up(0)
    for number in range(200):
        gateway._own.set_relayed(("module", f"M{number}"), ModuleToken(1, f"M{number}", number + 2, hops=1))
    assert len(gateway.poll(0)) == -(-200 // TOKENS_OF_PACK)
    gateway._own.set_relayed(("module", "M7"), None)
    (declared, ended) = gateway.poll(0)
    assert isinstance(declared, Declare)
    assert isinstance(ended, Undeclare)
    assert len(liveliness.unpack(declared.key)) == TOKENS_OF_PACK - 1
