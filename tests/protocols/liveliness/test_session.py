"""Discovery by liveliness tokens: modules on a network that is here a set of keys."""

from typing import TypeVar

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import liveliness, management
from r2p.codecs.liveliness import ModuleToken, TopicToken
from r2p.codecs.management import CLASS_LATCHES, FLAG_STOPPED, ROLE_GONE, ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.discovery.events import (
    Command,
    CommandReceived,
    Declare,
    Event,
    Mismatched,
    ModuleChanged,
    ModuleGone,
    NameConflict,
    PublisherFound,
    PublisherGone,
    Send,
    SubscriberJoined,
    SubscriberLeft,
    SubscribersGone,
    Undeclare,
)
from r2p.protocols.liveliness.session import LivelinessDiscovery
from r2p.version import __version__

E = TypeVar("E")
SECOND = 1_000_000_000
PRINT = b"a" * 8
OTHER = b"b" * 8


class World:
    """All modules on one network. What they are told is kept in `told`, by name."""

    def __init__(self) -> None:
        self.now = 0
        self.keys: dict[str, int] = {}
        self.members: dict[int, LivelinessDiscovery] = {}
        self.told: dict[int, list[Event]] = {}

    def add(self, name: str, instance: int, *, observer: bool = False) -> LivelinessDiscovery:
        discovery = LivelinessDiscovery(name, instance, observer=observer)
        self.members[instance] = discovery
        self.told[instance] = []
        self.connect(instance)
        return discovery

    def connect(self, instance: int) -> None:
        discovery = self.members[instance]
        self.act(instance, discovery.link_up(self.now))
        for key in self.keys:
            self.act(instance, discovery.appeared(self.now, key))
        self.settle()

    def crash(self, instance: int) -> None:
        """Its session is gone, and its tokens with it."""
        del self.members[instance]
        for key in [key for key, owner in self.keys.items() if owner == instance]:
            self._remove(key)
        self.settle()

    def act(self, instance: int, events: list[Event]) -> None:
        for event in events:
            match event:
                case Declare(key):
                    self.keys[key] = instance
                    for number, member in list(self.members.items()):
                        self.act(number, member.appeared(self.now, key))
                case Undeclare(key):
                    self._remove(key)
                case Send(data):
                    for number, member in list(self.members.items()):
                        if number != instance:
                            self.act(number, member.receive(self.now, data, instance))
                case _:
                    self.told[instance].append(event)

    def settle(self) -> None:
        """Poll all whose turn it is."""
        for _ in range(10):
            due = [n for n, each in self.members.items() if (at := each.next_deadline()) is not None and at <= self.now]
            for number in due:
                self.act(number, self.members[number].poll(self.now))

    def wait(self, seconds: float) -> None:
        end = self.now + round(seconds * SECOND)
        while self.now < end:
            self.now = min(end, self.now + SECOND // 10)
            self.settle()

    def news(self, instance: int, kind: type[E]) -> list[E]:
        """What it was told since the last look."""
        found: list[E] = [event for event in self.told[instance] if isinstance(event, kind)]
        rest: list[Event] = [event for event in self.told[instance] if not isinstance(event, kind)]
        self.told[instance] = rest
        return found

    def _remove(self, key: str) -> None:
        self.keys.pop(key, None)
        for number, member in list(self.members.items()):
            self.act(number, member.disappeared(self.now, key))


@pytest.fixture
def world() -> World:
    return World()


def advertise(world: World, instance: int, topic: str, size: int = 5, fingerprint: bytes = PRINT) -> None:
    world.act(instance, world.members[instance].advertise(world.now, topic, size, fingerprint))
    world.settle()


def subscribe(
    world: World, instance: int, topic: str, size: int = 5, fingerprint: bytes = PRINT, window: int = 8
) -> None:
    world.act(instance, world.members[instance].subscribe(world.now, topic, size, window, fingerprint))
    world.settle()


def test_modules_see_each_other_whoever_comes_first(world: World) -> None:
    a, b = world.add("A", 1), world.add("B", 2, observer=True)
    assert (list(a.modules), list(b.modules)) == (["B"], ["A"])
    assert (a.modules["B"].observer, b.modules["A"].observer) == (True, False)
    assert [event.info.name for event in world.news(1, ModuleChanged)] == ["B"]
    world.crash(2)
    assert not a.modules
    assert [event.info.name for event in world.news(1, ModuleGone)] == ["B"]


def test_modules_know_each_others_versions(world: World) -> None:
    a, b = world.add("A", 1), world.add("B", 2, observer=True)
    assert (b.modules["A"].wire, b.modules["A"].release) == (management.WIRE_VERSION, __version__)
    assert (a.modules["B"].wire, a.modules["B"].release) == (0, ""), "a tool declares none"
    hello = management.Hello("C", 3, 0, 1, 5000, 2, "9.9")
    world.act(1, a.relay(world.now, hello))
    world.settle()
    assert (b.modules["C"].wire, b.modules["C"].release, b.modules["C"].hops) == (2, "9.9", 1)
    world.act(1, a.relay(world.now, msgspec.structs.replace(hello, flags=management.HELLO_LEAVING)))
    world.settle()
    assert "C" not in b.modules
    assert not any("version/3" in key for key in world.keys)


def test_versions_may_come_before_their_module(world: World) -> None:
    a = world.add("A", 1)
    for key in ("2/7/version/7/1/0.2.0", "1/7/module/B/7/0/0"):
        world.act(1, a.appeared(world.now, key))
    assert [(each.info.name, each.info.release) for each in world.news(1, ModuleChanged)] == [("B", "0.2.0")]
    world.act(1, a.disappeared(world.now, "2/7/version/7/1/0.2.0"))
    assert (a.modules["B"].wire, a.modules["B"].release) == (0, "")


@pytest.mark.parametrize("publisher_first", [True, False])
def test_topics_are_matched_whoever_comes_first(world: World, publisher_first: bool) -> None:
    world.add("A", 1), world.add("B", 2)
    for role in (1, 2) if publisher_first else (2, 1):
        if role == 1:
            advertise(world, 1, "leds")
        else:
            subscribe(world, 2, "leds")
    assert world.news(1, SubscriberJoined) == [SubscriberJoined("leds", bytes(10), 8, 2)]
    assert world.news(2, PublisherFound) == [PublisherFound("leds", 1, bytes(10), 5)]
    world.act(2, world.members[2].unsubscribe(world.now, "leds"))
    world.settle()
    assert world.news(1, SubscriberLeft) == [SubscriberLeft("leds", 2)]
    assert world.news(1, SubscribersGone) == [SubscribersGone("leds")]
    assert world.news(2, PublisherGone) == [PublisherGone("leds", 1)]


def test_a_subscriber_that_is_sent_nothing_any_more_need_not_be_gone(world: World) -> None:
    world.add("A", 1), world.add("B", 2)
    advertise(world, 1, "leds")
    subscribe(world, 2, "leds")
    world.act(1, world.members[1].withdraw(world.now, "leds"))
    assert world.news(1, SubscriberLeft) == [SubscriberLeft("leds", 2, gone=False)]
    advertise(world, 1, "leds")
    world.crash(2)
    assert world.news(1, SubscriberLeft)[-1] == SubscriberLeft("leds", 2)


def test_a_late_joiner_learns_everything(world: World) -> None:
    world.add("A", 1)
    advertise(world, 1, "leds")
    for node in ("blink", "glow"):
        world.act(1, world.members[1].add_endpoint(world.now, node, "leds", ROLE_PUBLISHES, 1 | CLASS_LATCHES))
    world.settle()
    late = world.add("B", 2)
    subscribe(world, 2, "leds")
    assert world.news(2, PublisherFound) == [PublisherFound("leds", 1, bytes(10), 5)]
    assert {(each.module, each.node, each.publisher_class) for each in late.endpoints.values()} == {
        ("A", "blink", 129),
        ("A", "glow", 129),
    }
    assert late.topics["leds"].fingerprint == PRINT
    assert late.topics["leds"].size == 5


def test_one_token_for_a_publisher_and_its_node(world: World) -> None:
    a = world.add("A", 1)
    events = [
        *a.advertise(0, "leds", 5, PRINT),
        *a.add_endpoint(0, "blink", "leds", ROLE_PUBLISHES, 1),
        *a.poll(0),
    ]
    assert events == [Declare("1/1/pub/leds/1/blink/1/5/6161616161616161/0/0")]


def test_two_subscribers_part_one_by_one(world: World) -> None:
    for instance, name in ((1, "A"), (2, "B"), (3, "C")):
        world.add(name, instance)
    advertise(world, 1, "leds")
    subscribe(world, 2, "leds")
    subscribe(world, 3, "leds", window=0)
    assert [(each.source, each.queue) for each in world.news(1, SubscriberJoined)] == [(2, 8), (3, 0)]
    world.crash(2)
    assert world.news(1, SubscriberLeft) == [SubscriberLeft("leds", 2)]
    assert not world.news(1, SubscribersGone)
    world.crash(3)
    assert world.news(1, SubscribersGone) == [SubscribersGone("leds")]


def test_another_window_is_told(world: World) -> None:
    world.add("A", 1), world.add("B", 2)
    advertise(world, 1, "leds")
    subscribe(world, 2, "leds", window=0)
    subscribe(world, 2, "leds", window=16)
    assert [each.queue for each in world.news(1, SubscriberJoined)] == [0, 16]
    assert not world.news(1, SubscriberLeft)


@pytest.mark.parametrize(("size", "fingerprint"), [(6, PRINT), (5, OTHER)])
def test_types_that_do_not_fit_are_told_on_both_sides(world: World, size: int, fingerprint: bytes) -> None:
    world.add("A", 1), world.add("B", 2)
    advertise(world, 1, "leds")
    subscribe(world, 2, "leds", size, fingerprint)
    assert [(each.role, each.theirs.size) for each in world.news(1, Mismatched)] == [(ROLE_SUBSCRIBES, size)]
    assert [(each.role, each.theirs.size) for each in world.news(2, Mismatched)] == [(ROLE_PUBLISHES, 5)]
    assert not world.news(1, SubscriberJoined)
    assert not world.news(2, PublisherFound)
    assert world.members[2].topics["leds"].mismatch
    subscribe(world, 2, "leds")  # mended
    assert world.news(1, SubscriberJoined)
    assert world.news(2, PublisherFound)
    assert not world.members[2].topics["leds"].mismatch


def test_a_topic_has_different_types_until_the_last_other_one_is_gone(world: World) -> None:
    for instance in (1, 2, 3, 4):
        world.add(f"M{instance}", instance)
    advertise(world, 1, "leds")
    for instance, size in ((2, 8), (3, 9), (4, 5)):
        subscribe(world, instance, "leds", size)
    world.settle()
    topic = world.members[1].topics["leds"]
    for left in (2, 3):
        assert topic.mismatch
        world.crash(left)
    assert not topic.mismatch
    world.crash(4)
    assert not world.members[1].topics


def test_nothing_is_kept_of_modules_that_left(world: World) -> None:
    watcher = world.add("M1", 1)
    for instance in (2, 3):
        world.add(f"M{instance}", instance)
        advertise(world, instance, "leds", instance)
        world.members[instance].add_endpoint(0, "node", "leds", ROLE_PUBLISHES, 1)
    subscribe(world, 1, "leds", 2)
    world.settle()
    assert {each.module for each in watcher.endpoints.values()} <= {"M2", "M3"}
    for instance in (2, 3):
        world.crash(instance)
    assert not any([watcher.modules, watcher.endpoints, watcher.topics])
    modules, matching = watcher._modules, watcher._matching
    kept = [modules._names, modules._endpoints_of, modules._more_tokens, matching._sessions, matching._mismatches]
    assert not any([*kept, [*matching.demand]])


def test_a_type_that_changes_ends_what_flowed(world: World) -> None:
    world.add("A", 1), world.add("B", 2)
    advertise(world, 1, "leds")
    subscribe(world, 2, "leds")
    advertise(world, 1, "leds", 5, OTHER)
    assert world.news(1, SubscribersGone) == [SubscribersGone("leds")]
    assert world.news(2, PublisherGone) == [PublisherGone("leds", 1)]
    assert world.news(2, Mismatched)


def test_whoever_knows_no_type_gets_it_anyway(world: World) -> None:
    world.add("A", 1), world.add("B", 2)
    advertise(world, 1, "leds")
    subscribe(world, 2, "leds", 0, bytes(8))
    assert world.news(1, SubscriberJoined)
    assert world.news(2, PublisherFound)


def test_orders_reach_the_module_that_they_name(world: World) -> None:
    world.add("A", 1), world.add("B", 2), world.add("C", 3)
    for command in Command:
        world.act(1, world.members[1].command(world.now, command, "B"))
    assert [each.command for each in world.news(2, CommandReceived)] == list(Command)
    assert not world.news(3, CommandReceived)


def test_flags_are_told(world: World) -> None:
    a = world.add("A", 1)
    world.add("B", 2)
    world.news(2, ModuleChanged)
    world.act(1, a.set_flags(world.now, FLAG_STOPPED))
    world.settle()
    assert [each.info.flags for each in world.news(2, ModuleChanged)] == [FLAG_STOPPED]
    assert not world.news(2, ModuleGone)
    assert sum(1 for key in world.keys if "module,A," in key) == 1


def test_namesakes_are_told_when_both_stay(world: World) -> None:
    world.add("X", 1), world.add("X", 2), world.add("C", 3)
    world.wait(1.0)
    assert not world.news(1, NameConflict)
    world.wait(1.0)
    assert world.news(1, NameConflict) == [NameConflict("X", 1, 2)]
    assert world.news(2, NameConflict) == [NameConflict("X", 2, 1)]
    assert world.news(3, NameConflict) == [NameConflict("X", 1, 2)]


def test_a_module_that_comes_back_is_no_namesake(world: World) -> None:
    world.add("X", 1), world.add("C", 3)
    world.add("X", 2)  # the old one's session hangs still
    world.wait(1.0)
    world.crash(1)
    world.wait(5.0)
    assert not world.news(2, NameConflict)
    assert not world.news(3, NameConflict)
    assert world.members[3].modules["X"].instance == 2


def test_somebody_else_tells_namesakes(world: World) -> None:
    world.add("X", 1), world.add("C", 3)
    world.act(3, world.members[3].report_conflict(world.now, "X", 1, 77))
    assert world.news(1, NameConflict) == [NameConflict("X", 1, 77)]


def test_when_the_network_goes_all_are_gone_and_come_again(world: World) -> None:
    a = world.add("A", 1)
    world.add("B", 2)
    advertise(world, 1, "leds")
    subscribe(world, 2, "leds")
    world.told[1].clear()
    world.act(1, a.link_down(world.now))
    assert not a.modules
    assert not a.topics
    assert world.news(1, SubscribersGone) == [SubscribersGone("leds")]
    assert not world.members[2].modules  # and we are gone for the others
    world.connect(1)
    assert list(a.modules) == ["B"]
    assert world.news(1, SubscriberJoined) == [SubscriberJoined("leds", bytes(10), 8, 2)]
    assert world.news(2, PublisherFound)[-1].source == 1


def test_nothing_is_said_while_the_network_is_away() -> None:
    a = LivelinessDiscovery("A", 1)
    assert a.advertise(0, "leds", 5) == []
    assert a.command(0, Command.STOP, "B") == []
    assert a.poll(0) == []
    assert a.next_deadline() is None
    assert {type(event) for event in a.link_up(0)} == {Declare}


def test_what_lives_is_as_good_as_just_heard(world: World) -> None:
    a = world.add("A", 1)
    world.add("B", 2)
    advertise(world, 2, "leds")
    world.wait(60.0)
    a.refresh_ages(world.now)
    assert world.now - a.modules["B"].last_heard <= SECOND
    assert world.now - (a.topics["leds"].advertised_at or 0) <= SECOND


def test_firmware_behind_a_gateway(world: World) -> None:
    """Its signs of life come through, so its age is seen; its gateway takes it along when it goes."""
    gateway = world.add("GW", 1)
    pc = world.add("PC", 2)
    world.act(1, gateway.relay(world.now, management.Alive("IMU", 0)))
    world.wait(3.0)
    assert pc.modules["IMU"].instance is None
    assert pc.modules["IMU"].hops == 1
    assert world.now - pc.modules["IMU"].last_heard == 3 * SECOND


def test_r2p_modules_behind_a_gateway(world: World) -> None:
    gateway = world.add("GW", 1)
    pc = world.add("PC", 2)
    relayed: list[management.Hello | management.Alive | management.Endpoint] = [
        management.Hello("ROBOT", 99, 0, 1),
        management.Alive("ROBOT", FLAG_STOPPED),
        management.Endpoint(ROLE_PUBLISHES, 99, "imu", "tilt", 3),
    ]
    for message in relayed:
        world.act(1, gateway.relay(world.now, message))
    world.settle()
    robot = pc.modules["ROBOT"]
    assert (robot.instance, robot.hops, robot.flags, robot.source) == (99, 1, FLAG_STOPPED, 1)
    assert [(each.module, each.node) for each in pc.endpoints.values()] == [("ROBOT", "imu")]
    subscribe(world, 2, "tilt", 0, bytes(8))
    assert not world.news(2, PublisherFound)  # the gateway says by a token of its own what it passes on
    world.act(1, gateway.relay(world.now, management.Endpoint(ROLE_PUBLISHES | ROLE_GONE, 99, "imu", "tilt")))
    world.act(1, gateway.relay(world.now, management.Hello("ROBOT", 99, management.HELLO_LEAVING, 1)))
    world.settle()
    assert not pc.endpoints
    assert "ROBOT" not in pc.modules


def test_a_module_behind_a_gateway_starts_anew(world: World) -> None:
    """Its new start is announced before the end of the old one, which removes nothing else."""
    gateway = world.add("GW", 1)
    pc = world.add("PC", 2)
    for instance, flags in ((98, 0), (99, 0), (98, management.HELLO_LEAVING)):
        world.act(1, gateway.relay(world.now, management.Hello("ROBOT", instance, flags, 1)))
        world.settle()
    assert pc.modules["ROBOT"].instance == 99
    world.act(1, gateway.relay(world.now, management.Hello("ROBOT", 99, management.HELLO_LEAVING, 1)))
    world.settle()
    assert "ROBOT" not in pc.modules


def test_a_gateway_dies_and_takes_along_what_was_behind_it(world: World) -> None:
    gateway = world.add("GW", 1)
    pc = world.add("PC", 2)
    world.act(1, gateway.relay(world.now, management.Hello("ROBOT", 99, 0, 1)))
    world.settle()
    world.crash(1)
    assert not pc.modules


def test_the_nearest_of_two_ways_to_a_module_counts(world: World) -> None:
    for instance, hops in ((1, 2), (3, 1)):
        gateway = world.add(f"GW{instance}", instance)
        world.act(instance, gateway.relay(world.now, management.Hello("ROBOT", 99, 0, hops)))
    pc = world.add("PC", 2)
    assert (pc.modules["ROBOT"].hops, pc.modules["ROBOT"].source) == (1, 3)
    world.crash(3)
    assert pc.modules["ROBOT"].hops == 2
    world.wait(3.0)
    assert not world.news(2, NameConflict)


def test_a_module_does_not_see_itself_behind_a_gateway(world: World) -> None:
    gateway = world.add("GW", 1)
    pc = world.add("PC", 2)
    world.act(1, gateway.relay(world.now, management.Hello("PC", 2, 0, 1)))
    world.settle()
    assert "PC" not in pc.modules


def test_demand_for_gateways(world: World) -> None:
    gateway = world.add("GW", 1)
    world.add("A", 2)
    demand = gateway.demand()
    advertise(world, 2, "leds")
    subscribe(world, 2, "cmd")
    assert (demand.is_published("leds"), demand.is_subscribed("leds"), demand.is_subscribed("cmd")) == (
        True,
        False,
        True,
    )
    assert demand.pop_changed() == {"leds", "cmd"}
    world.crash(2)
    assert not demand.is_published("leds")
    assert demand.pop_changed() == {"leds", "cmd"}


def test_garbage_is_counted() -> None:
    a = LivelinessDiscovery("A", 1)
    a.link_up(0)
    for key in ("", "1/zz", "2/1/module/X/1/0/0"):
        assert a.appeared(0, key) == []
        assert a.disappeared(0, key) == []
    for data in (b"", b"x" * 32, b"y" * 5000):
        assert a.receive(0, data, 5) == []
    assert a.counts == {"undecodable": 3, "unknown type": 3}


@given(st.lists(st.tuples(st.integers(0, 7), st.booleans()), max_size=60))
def test_any_order_of_tokens_leaves_what_is_there(steps: list[tuple[int, bool]]) -> None:
    """Tokens may come twice, go twice, and go before they came."""
    tokens: list[liveliness.Token] = [
        ModuleToken(2, "B", 2),
        ModuleToken(3, "B", 3),
        ModuleToken(2, "B", 2, FLAG_STOPPED),
        TopicToken(2, ROLE_PUBLISHES, "leds", 2, "x", 1, 5, PRINT),
        TopicToken(2, ROLE_PUBLISHES, "leds", 2, "y", 1, 5, PRINT),
        TopicToken(2, ROLE_SUBSCRIBES, "cmd", 2, "x", 0, 5, PRINT, 8),
        TopicToken(3, ROLE_SUBSCRIBES, "cmd", 3, "x", 0, 5, PRINT, 0),
        TopicToken(3, ROLE_SUBSCRIBES, "cmd", 3, "x", 0, 6, PRINT, 0),
    ]
    keys = [liveliness.encode(token) for token in tokens]
    a = LivelinessDiscovery("A", 1)
    events = [*a.link_up(0), *a.subscribe(0, "leds", 5, 8, PRINT), *a.advertise(0, "cmd", 5, PRINT)]
    there: set[int] = set()
    for number, comes in steps:
        events += a.appeared(0, keys[number]) if comes else a.disappeared(0, keys[number])
        (there.add if comes else there.discard)(number)
    balance = {2: 0, 3: 0}
    for event in events:
        match event:
            case PublisherFound(_, int(source)) | SubscriberJoined(_, _, _, int(source)):
                balance[source] += 1
            case PublisherGone(_, int(source)) | SubscriberLeft(_, int(source)):
                balance[source] -= 1
    assert ("B" in a.modules) == bool(there & {0, 1, 2})
    assert ("leds" in a.topics) == bool(there & {3, 4})
    assert ("cmd" in a.topics) == bool(there & {5, 6, 7})
    assert balance[2] == bool(there & {3, 4}) + (5 in there)
    a.link_down(0)
    assert not a.modules
    assert not a.topics
    assert not a.endpoints


@pytest.mark.parametrize("name", ["a#b", "a*b", "a//b", "$*", "a/b/c"])
def test_names_behind_a_gateway_that_no_token_carries(name: str) -> None:
    """They are counted, and the others are told as ever."""
    gateway = LivelinessDiscovery("GW", 1)
    gateway.link_up(0)
    for message in (
        management.Hello(name, 98, 0, 1),
        management.Endpoint(ROLE_PUBLISHES, 98, name, "tilt"),
        management.Endpoint(ROLE_PUBLISHES, 98, "imu", f"{name}*"),
        management.Hello("ROBOT", 99, 0, 1),
        management.Alive("ROBOT", 0xFF),
    ):
        gateway.relay(0, message)
    assert gateway.poll(0) == [Declare("1/1/module/ROBOT/63/7f/1")]
    assert gateway.counts == {"name not carried": 3}
