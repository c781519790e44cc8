"""Names that are too long for their fields: what they mean on a link, whatever other modules claim."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import management as m
from r2p.names import chosen_alias, module_alias, module_path, node_alias, topic_alias
from r2p.protocols.discovery.aliases import ModuleAliases
from r2p.protocols.discovery.events import AliasConflict, AliasesDiffer, AliasFreed, Event, PublisherFound
from r2p.protocols.discovery.session import Discovery
from tests.protocols.discovery.wire import ME, ONE, PC2, PEER, S, changes_in, hear, run, sent, started

if TYPE_CHECKING:
    from collections.abc import Sequence

LONG = "front_left/wheel/velocity_estimate"
ONE_OF_TWO, OTHER_OF_TWO = "front_left_wheel/velocity1421", "front_left_wheel/velocity1927"
"""Two topics of one alias."""
SHORT, ITS_RIVAL, ITS_NEXT = "imu_raw_filtered", "imu_raw_filt/er751329", "imu_raw_filt/211802x"
"""A topic of 16 characters, and two names with it as their alias."""
NODES = "velocity352", "velocity1003"


def claims(*names: str, kind: int = m.KIND_TOPIC) -> list[m.LongName]:
    return [message for name in names for message in m.long_name_messages(kind, name)]


def module_with(*topics: str, aliases: dict[str, str] | None = None) -> tuple[Discovery, list[Event]]:
    """A module that subscribes these topics on a link that is up; and what claiming them has brought."""
    discovery = Discovery("PC1", ME, aliases=aliases)
    events: list[Event] = []
    for topic in topics:
        events += discovery.claim(topic)
        if not discovery.rival(topic):
            discovery.subscribe(0, topic, 5, 5, ONE)
    discovery.link_up(0)
    run(discovery, 0, 100_000_000)
    return discovery, events


def offered(discovery: Discovery, now: int = S) -> list[str]:
    """The topics whose requests this module sends from now on."""
    events = [event for _, event in run(discovery, now, now + 8 * S)]
    return sorted({each.topic for each in sent(events) if isinstance(each, m.SubscribeRequest)})


# What a name is on the wire


def test_names_that_fit_pass_unchanged() -> None:
    discovery, _ = module_with("leds")
    discovery.advertise(0, "x" * 16, 5)
    discovery.add_endpoint(0, "n" * 8, "x" * 16, m.ROLE_PUBLISHES, m.CLASS_NRT)
    hear(discovery, S, PC2)
    messages = sent([event for _, event in run(discovery, S, 10 * S)])
    assert not any(isinstance(each, m.Name | m.LongName) for each in messages)
    assert any(isinstance(each, m.Endpoint) and (each.node, each.topic) == ("n" * 8, "x" * 16) for each in messages)
    assert all(each.flags & m.HELLO_ALIAS == 0 for each in messages if isinstance(each, m.Hello))


def test_a_long_name_is_announced_before_what_has_its_alias() -> None:
    discovery = Discovery("front_left_wheel_controller", ME)
    discovery.advertise(0, LONG, 5, ONE)
    discovery.add_endpoint(0, "velocity_estimator", LONG, m.ROLE_PUBLISHES, m.CLASS_NRT)
    events = discovery.link_up(0) + hear(discovery, 0, PC2)
    messages = sent(events + [event for _, event in run(discovery, 0, S)])
    alias = module_alias("front_left_wheel_controller")
    first = {type(each): at for at, each in reversed(list(enumerate(messages)))}
    assert first[m.Name] < first[m.Hello]
    topic, node = topic_alias(LONG), node_alias("velocity_estimator")
    assert first[m.LongName] < min(first[each] for each in (m.Advertise, m.TypeInfo, m.Endpoint))
    assert {each.topic for each in messages if isinstance(each, m.Advertise | m.TypeInfo)} == {topic}
    (endpoint,) = {each for each in messages if isinstance(each, m.Endpoint)}
    assert (endpoint.node, endpoint.topic) == (node, topic)
    hello = next(each for each in messages if isinstance(each, m.Hello))
    assert (hello.module, hello.flags & m.HELLO_ALIAS) == (alias, m.HELLO_ALIAS)
    other = Discovery("PC2", PEER)
    other.link_up(0)
    hear(other, S, *messages)
    assert set(other.modules) == {"front_left_wheel_controller"}
    assert {(each.node, each.topic) for each in other.endpoints.values()} == {("velocity_estimator", LONG)}


def test_what_a_module_uses_itself_it_understands_without_being_told() -> None:
    discovery, _ = module_with(LONG)
    response = m.SubscribeResponse(topic_alias(LONG), 5)
    assert hear(discovery, S, response) == [PublisherFound(LONG, None, response.params, 5)]
    assert not discovery.rival(LONG)


def test_what_was_heard_before_its_name_is_renamed() -> None:
    discovery = Discovery("GW", ME)
    demand = discovery.demand()
    discovery.link_up(0)
    alias, node = topic_alias(LONG), node_alias("velocity_estimator")
    hear(discovery, 0, PC2, m.TypeInfo(1, alias, ONE, 5), m.Advertise(alias, 5))
    hear(discovery, 0, m.Endpoint(1, PEER, node, alias, m.CLASS_NRT))
    assert demand.pop_changed() == {alias}
    *almost, last = claims(LONG) + claims("velocity_estimator", kind=m.KIND_NODE)
    hear(discovery, S, *reversed(almost))
    assert demand.pop_changed() == {alias, LONG}
    assert not demand.is_published(alias)
    assert demand.is_published(LONG)
    hear(discovery, S, last)
    info = discovery.topics[LONG]
    assert (info.name, info.size, info.fingerprint, alias in discovery.topics) == (LONG, 5, ONE, False)
    ((key, endpoint),) = discovery.endpoints.items()
    assert key == (PEER, "velocity_estimator", LONG, 1)
    assert (endpoint.node, endpoint.topic, endpoint.module) == ("velocity_estimator", LONG, "PC2")
    run(discovery, S, 30 * S)  # leases have moved along, and end
    assert not demand.is_published(LONG)
    assert not discovery.endpoints


# Two names of one alias


def test_two_names_of_one_module() -> None:
    discovery, events = module_with(ONE_OF_TWO, OTHER_OF_TWO)
    alias = topic_alias(ONE_OF_TWO)
    assert events == [AliasConflict(m.KIND_TOPIC, alias, ONE_OF_TWO, OTHER_OF_TWO, OTHER_OF_TWO)]
    assert discovery.rival(OTHER_OF_TWO) == ONE_OF_TWO
    assert discovery.release(ONE_OF_TWO) == [AliasFreed(OTHER_OF_TWO)]
    assert not discovery.rival(OTHER_OF_TWO)


def test_a_short_name_takes_its_place_from_a_longer_one() -> None:
    discovery, events = module_with(ITS_RIVAL, SHORT)
    assert events == [AliasConflict(m.KIND_TOPIC, SHORT, SHORT, ITS_RIVAL, ITS_RIVAL)]
    assert (discovery.rival(SHORT), discovery.rival(ITS_RIVAL)) == ("", SHORT)


def test_two_names_of_two_modules_are_refused_while_both_are_there() -> None:
    discovery, _ = module_with(ONE_OF_TWO)
    alias = topic_alias(ONE_OF_TWO)
    conflict = AliasConflict(m.KIND_TOPIC, alias, ONE_OF_TWO, OTHER_OF_TWO, ONE_OF_TWO)
    assert changes_in(hear(discovery, S, *claims(OTHER_OF_TWO))) == [conflict]
    assert not changes_in(hear(discovery, 30 * S, *claims(OTHER_OF_TWO)))
    assert discovery.rival(ONE_OF_TWO) == OTHER_OF_TWO
    run(discovery, 30 * S, 89 * S)
    assert discovery.rival(ONE_OF_TWO)
    assert AliasFreed(ONE_OF_TWO) in [event for _, event in run(discovery, 89 * S, 91 * S)]
    assert not discovery.rival(ONE_OF_TWO)


def test_a_short_name_stays_and_so_does_the_long_one_but_both_learn_of_it() -> None:
    discovery, _ = module_with(SHORT)
    events = hear(discovery, S, *claims(ITS_RIVAL)) + discovery.poll(S)
    assert changes_in(events) == [AliasConflict(m.KIND_TOPIC, SHORT, SHORT, ITS_RIVAL)]
    assert not discovery.rival(SHORT)
    answer = [each for each in sent(events) if isinstance(each, m.LongName)]
    assert answer == claims(SHORT)
    other, _ = module_with(ITS_RIVAL)
    assert changes_in(hear(other, S, *answer)) == [AliasConflict(m.KIND_TOPIC, SHORT, ITS_RIVAL, SHORT)]
    assert not other.rival(ITS_RIVAL)
    assert changes_in(hear(other, S, *claims(ITS_NEXT))) == [
        AliasConflict(m.KIND_TOPIC, SHORT, ITS_RIVAL, ITS_NEXT, ITS_RIVAL)
    ]
    assert other.rival(ITS_RIVAL) == ITS_NEXT


def test_a_tool_may_use_an_alias_as_a_name() -> None:
    tool = Discovery("_x1y2z3", ME, observer=True)
    tool.claim(SHORT)
    tool.subscribe(0, SHORT, 5, 5, ONE)
    tool.link_up(0)
    events = hear(tool, S, *claims(ITS_RIVAL)) + tool.poll(S)
    assert not [each for each in sent(events) if isinstance(each, m.LongName)]
    assert set(offered(tool)) == {SHORT}


@pytest.mark.parametrize("names", [(ITS_RIVAL, SHORT), (SHORT, ITS_RIVAL), (ONE_OF_TWO, OTHER_OF_TWO)])
def test_a_third_module_shows_the_alias_of_two_names(names: Sequence[str]) -> None:
    discovery, _ = module_with()
    alias = topic_alias(names[0])
    hear(discovery, S, PC2, m.Advertise(alias, 5))
    events = hear(discovery, S, *claims(*names))
    assert [type(each) for each in changes_in(events)] == [AliasConflict]
    hear(discovery, S, m.Advertise(alias, 5))
    assert set(discovery.topics) == {alias}


def test_nodes_of_one_alias() -> None:
    discovery, _ = module_with()
    discovery.add_endpoint(0, NODES[0], "leds", m.ROLE_PUBLISHES)
    events = changes_in(hear(discovery, S, *claims(NODES[1], kind=m.KIND_NODE)))
    assert events == [AliasConflict(m.KIND_NODE, node_alias(NODES[0]), *NODES)]


# Aliases that were chosen


def test_a_chosen_alias_travels_and_is_announced_as_chosen() -> None:
    discovery, _ = module_with(LONG, aliases={LONG: "flw_vel"})
    assert offered(discovery) == ["flw_vel"]
    assert hear(discovery, S, m.SubscribeResponse("flw_vel", 5)) == [PublisherFound(LONG, None, bytes(10), 5)]
    names = [each for each in sent([event for _, event in run(discovery, 10 * S, 30 * S)]) if type(each) is m.LongName]
    assert set(names) == set(claims(f"flw_vel={LONG}"))


def test_a_chosen_alias_is_not_believed_by_others() -> None:
    discovery, _ = module_with("leds")
    hear(discovery, S, PC2, m.Advertise("flw_vel", 5), *claims(f"flw_vel={LONG}"))
    assert set(discovery.topics) == {"flw_vel"}
    (conflict,) = changes_in(hear(discovery, S, *claims(f"leds={LONG}")))
    assert conflict == AliasConflict(m.KIND_TOPIC, "leds", "leds", LONG)
    assert not discovery.rival("leds")


@pytest.mark.parametrize(
    ("aliases", "claim", "ours", "theirs"),
    [({}, f"flw_vel={LONG}", topic_alias(LONG), "flw_vel"), ({LONG: "flw_vel"}, LONG, "flw_vel", topic_alias(LONG))],
)
def test_two_aliases_of_one_name_are_reported(aliases: dict[str, str], claim: str, ours: str, theirs: str) -> None:
    discovery, _ = module_with(LONG, aliases=aliases)
    assert changes_in(hear(discovery, S, *claims(claim))) == [AliasesDiffer(LONG, ours, theirs)]
    assert not discovery.rival(LONG)


# Made-up claims

_NAMES = st.sampled_from([LONG, ONE_OF_TWO, OTHER_OF_TWO, SHORT, ITS_RIVAL, ITS_NEXT, "leds", "robot1/leds", *NODES])
_TEXTS = st.one_of(
    _NAMES,
    st.builds("{}={}".format, st.sampled_from(["leds", SHORT, topic_alias(LONG), "R2P", "x y", ""]), _NAMES),
    st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=60),
)
_WHOLE = st.builds(m.long_name_messages, st.integers(0, 3), _TEXTS)
_PIECES = st.builds(
    m.LongName,
    st.integers(0, 255),
    st.integers(0, 255),
    st.integers(0, 0xFFFFFFFF) | st.just(m.long_name_number(ITS_RIVAL)),
    st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=24),
).map(lambda piece: [piece])
_CLAIMS = st.lists(_WHOLE | _PIECES, max_size=40).map(lambda lists: [each for some in lists for each in some])


@given(_CLAIMS)
def test_no_claim_renames_a_topic_with_a_short_name(messages: list[m.LongName]) -> None:
    """Of this module whatever its length, and of others up to 15 characters: aliases have 16."""
    discovery, _ = module_with("leds", SHORT, aliases={})
    demand = discovery.demand()
    hear(discovery, S, PC2, *messages)
    offers = [m.Advertise(name, 5) for name in ("leds", SHORT, "odometry", "robot1/leds")]
    hear(discovery, S, *offers)
    hear(discovery, 2 * S, *messages)
    assert demand.topics() == {"leds", SHORT, "odometry", "robot1/leds"}
    assert not discovery.rival("leds") + discovery.rival(SHORT)
    assert set(discovery.topics) == {"leds", SHORT, "odometry", "robot1/leds"}


@given(_CLAIMS)
def test_a_long_name_is_understood_or_refused_and_never_another_one(messages: list[m.LongName]) -> None:
    discovery, _ = module_with(LONG)
    hear(discovery, S, PC2, *messages)
    found = changes_in(hear(discovery, S, m.SubscribeResponse(topic_alias(LONG), 5)))
    assert found == [PublisherFound(LONG, None, bytes(10), 5)]
    hear(discovery, S, m.Advertise(SHORT, 5))
    assert set(discovery.topics) <= {LONG, SHORT, ITS_RIVAL, ITS_NEXT}
    chosen = "".join(each.piece for each in messages).count(f"{topic_alias(LONG)}=")
    assert not discovery.rival(LONG) or chosen


def test_a_piece_of_another_name_completes_none() -> None:
    discovery, _ = module_with()
    first, last = claims(LONG)
    forged = m.LongName(last.kind, last.part, last.number, "y_forged")
    hear(discovery, S, PC2, m.Advertise(topic_alias(LONG), 5), first, forged)
    assert discovery.counts["impossible name"] == 1
    assert set(discovery.topics) == {topic_alias(LONG)}
    hear(discovery, S, first, last)
    assert set(discovery.topics) == {LONG}


def test_made_up_names_are_bounded() -> None:
    discovery, _ = module_with()
    discovery.limit_tables(100)
    names = discovery._names
    for number in range(600):
        hear(discovery, S, *claims(f"made_up_topics/{number}"), m.LongName(1, 0x0F, number, "part"))
    assert len(names._learnt) == 100
    assert discovery.counts["names forgotten"] == 500
    assert len(names._parts) <= 256


# Modules

MODULES = ["robot1/MOTOR1", "a/b", "ABC_DEFGH", "sixteen_letters_/" + "M" * 64]


def test_short_names_are_their_own_aliases() -> None:
    assert module_alias("MOTOR1") == "MOTOR1"
    assert m.alias_messages("MOTOR1") == []


@pytest.mark.parametrize("name", MODULES)
def test_the_name_of_a_module_travels_in_pieces(name: str) -> None:
    aliases = ModuleAliases("PC1", Counter())
    alias = module_alias(module_path(name))
    assert len(alias) <= 7
    assert aliases.name_of(alias) == alias
    received = [m.decode(m.encode(each)) for each in m.alias_messages(name)]
    complete = [aliases.receive(each) for each in reversed(received) if isinstance(each, m.Name)]
    assert complete[-1] == name
    assert aliases.name_of(alias) == name


def test_an_alias_that_does_not_fit_is_not_believed() -> None:
    aliases = ModuleAliases("PC1", Counter())
    assert aliases.receive(m.Name("MOTOR1", 0, "robot1/MOTOR1")) is None
    assert aliases.name_of("MOTOR1") == "MOTOR1"


def test_made_up_aliases_of_modules_are_bounded() -> None:
    own = "front_left_wheel_controller"
    counts: Counter[str] = Counter()
    aliases = ModuleAliases(own, counts)
    aliases.most = 100
    for number in range(1000):
        name = f"robot/{number}"
        aliases.receive(m.Name(module_alias(name), 0, name))
        aliases.receive(m.Name(f"x{number}", 0x0F, "part"))
    assert len(aliases._names) == 100
    assert counts == {"names forgotten": 900}
    assert len(aliases._parts) <= 256
    assert aliases.name_of(module_alias(own)) == own


def test_a_module_with_an_alias_is_known_only_by_its_name() -> None:
    name = "front_left_wheel_controller"
    alias = module_alias(name)
    hello = m.Hello(alias, PEER, m.HELLO_ALIAS)
    discovery, _ = module_with("leds")
    hear(discovery, S, hello, m.Alive(alias))
    assert not discovery.modules
    hear(discovery, S, *m.alias_messages(name), hello, m.Alive(alias, m.FLAG_STOPPED))
    (info,) = discovery.modules.values()
    assert (info.name, info.instance, info.flags) == (name, PEER, m.FLAG_STOPPED)


def test_no_claim_renames_a_module_with_a_short_name() -> None:
    name = "front_left_wheel_controller"
    short = module_alias(name)  # by chance
    discovery, _ = module_with("leds")
    hear(discovery, S, m.Hello(short, PEER), m.Alive(short), *m.alias_messages(name))
    hear(discovery, S, m.Hello(short, PEER), m.Alive(short, m.FLAG_STOPPED))
    ((found, info),) = discovery.modules.items()
    assert (found, info.name, info.flags) == (short, short, m.FLAG_STOPPED)


def test_services_of_a_chosen_alias() -> None:
    aliases = {"front_left/calibrate": "fl_cal"}
    discovery, _ = module_with("front_left/calibrate_q", aliases=aliases)
    assert offered(discovery) == ["fl_cal_q"] == [chosen_alias("front_left/calibrate_q", aliases)]


def test_what_came_under_an_alias_gets_the_name_also_if_this_module_has_taken_it_meanwhile() -> None:
    discovery = started()
    name = "arm/left/joint_states"
    alias = discovery.alias(name)
    hear(discovery, S, m.Hello("PC2", 2), m.Endpoint(m.ROLE_PUBLISHES, 2, "drive", alias, 1))
    discovery.claim(name)
    hear(discovery, S, *m.long_name_messages(m.KIND_TOPIC, name), m.Endpoint(m.ROLE_PUBLISHES, 2, "drive", alias, 1))
    assert [each.topic for each in discovery.endpoints.values()] == [name]
