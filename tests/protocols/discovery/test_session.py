"""What is said at the start and ever again, and what strangers may do."""

import itertools

import pytest

from r2p.codecs import management as m
from r2p.protocols.discovery.events import (
    Command,
    Event,
    ModuleGone,
    TableFull,
)
from r2p.protocols.discovery.session import Discovery
from tests.protocols.discovery.wire import (
    ME,
    MS,
    PC2,
    PEER,
    REQUEST,
    SOON,
    S,
    hear,
    joined,
    own_hello,
    run,
    sent,
    started,
)


class TestStart:
    def test_nothing_is_said_before_the_link_is_up(self) -> None:
        discovery = Discovery("PC1", ME)
        assert discovery.advertise(0, "leds", 5) == []
        assert discovery.query(0) == []
        assert discovery.command(0, Command.STOP, "IMU1") == []
        assert discovery.next_deadline() is None

    def test_link_up_introduces_asks_and_announces(self) -> None:
        discovery = Discovery("PC1", ME)
        discovery.set_flags(0, m.FLAG_STOPPED)
        discovery.advertise(0, "leds", 5, params=b"\x28\x18" + bytes(8))
        discovery.subscribe(0, "cmd", 12, 5)
        assert sent(discovery.link_up(S)) == [
            own_hello(m.HELLO_QUERY),
            m.Alive("PC1", m.FLAG_STOPPED),
            m.Advertise("leds", 5, 0, b"\x28\x18" + bytes(8)),
            m.SubscribeRequest("cmd", 12, 5),
        ]

    def test_a_tool_is_no_module(self) -> None:
        discovery = Discovery("_x1y2z3", ME, observer=True)
        assert sent(discovery.link_up(0)) == [own_hello(m.HELLO_QUERY | m.HELLO_TOOL, "_x1y2z3")]
        assert {type(message) for _, event in run(discovery, 0, 9 * S) for message in sent([event])} == {m.Hello}

    def test_what_is_new_is_announced_at_once(self) -> None:
        discovery = started()
        assert sent(discovery.advertise(SOON, "odometry", 20)) == [m.Advertise("odometry", 20)]
        assert sent(discovery.subscribe(SOON, "pose", 20)) == [m.SubscribeRequest("pose", 20, 5)]
        assert sent(discovery.set_flags(SOON, m.FLAG_STOPPED))[1:] == [m.Alive("PC1", m.FLAG_STOPPED)]
        assert sent(discovery.advertise(SOON, "odometry", 20)) == []
        assert sent(discovery.set_flags(SOON, m.FLAG_STOPPED)) == []

    @pytest.mark.parametrize(
        ("size", "queue", "told"),
        [(20, 0, 1), (20, 1, 1), (20, 5, 5), (20, 70000, 16), (120, 16, 8), (121, 16, 7), (1016, 5, 1), (1024, 5, 1)],
    )
    def test_queues_that_firmware_can_hold(self, size: int, queue: int, told: int) -> None:
        """A queue of 0 halts it; one that its heap can't hold makes it write to NULL."""
        discovery = started()
        assert sent(discovery.subscribe(SOON, "pose", size, queue)) == [m.SubscribeRequest("pose", size, told)]

    def test_a_topic_of_unknown_size_is_not_asked_for(self) -> None:
        discovery = started()
        assert sent(discovery.subscribe(SOON, "pose")) == []
        said = [message for _, event in run(discovery, SOON, 60 * S) for message in sent([event])]
        assert not any(isinstance(each, m.SubscribeRequest) and each.topic == "pose" for each in said)
        assert sent(hear(discovery, 60 * S, m.Advertise("pose", 120))) == [m.SubscribeRequest("pose", 120, 5)]
        said = [message for _, event in run(discovery, 60 * S, 62 * S) for message in sent([event])]
        assert m.SubscribeRequest("pose", 120, 5) in said, "it is repeated"

    def test_a_size_that_has_been_heard_before_will_do(self) -> None:
        discovery = started()
        hear(discovery, SOON, m.Advertise("pose", 250))
        assert sent(discovery.subscribe(2 * SOON, "pose")) == [m.SubscribeRequest("pose", 250, 3)]

    def test_r2p_modules_get_an_unknown_size_as_a_type(self) -> None:
        discovery = started()
        hear(discovery, SOON, PC2)
        discovery.poll(SOON)
        assert sent(discovery.subscribe(SOON, "pose")) == [m.TypeInfo(m.ROLE_SUBSCRIBES, "pose", m.ANY_TYPE, 0)]

    def test_good_bye_is_the_last_word(self) -> None:
        discovery = started()
        assert sent(discovery.leave(S)) == [own_hello(m.HELLO_LEAVING)]
        assert hear(discovery, S, REQUEST) == []
        assert discovery.next_deadline() is None
        assert discovery.counts["link down"] == 1


class TestRepetition:
    def times(self, discovery: Discovery, start: int, end: int) -> list[tuple[float, str]]:
        return [
            (round((now - start) / S, 2), type(message).__name__)
            for now, event in run(discovery, start, end)
            for message in sent([event])
        ]

    def test_one_step_every_half_second(self) -> None:
        discovery = Discovery("PC1", ME)
        discovery.advertise(0, "leds", 5)
        discovery.subscribe(0, "cmd", 12)
        discovery.link_up(0)
        assert self.times(discovery, 0, 2 * S + 1) == [
            (0.5, "Advertise"),
            (1.0, "SubscribeRequest"),
            (1.5, "Hello"),
            (1.5, "Alive"),
            (2.0, "Advertise"),
        ]

    def test_many_share_a_second_and_a_half(self) -> None:
        discovery = Discovery("PC1", ME, burst=200)
        for n in range(99):
            discovery.advertise(0, f"t{n}", 1)
        discovery.link_up(0)
        times = self.times(discovery, 0, 15 * S)
        assert len(times) == pytest.approx(10 * (99 + 2), rel=0.02)

    def test_the_rate_is_kept_whatever_there_is_to_say(self) -> None:
        discovery = Discovery("PC1", ME, rate=100, burst=10)
        for n in range(500):
            discovery.advertise(0, f"t{n}", 1)
        assert len(discovery.link_up(0)) <= 10
        discovery.receive(0, m.encode(m.Hello("PC2", PEER, m.HELLO_QUERY)))
        times = [now for now, event in run(discovery, 0, 20 * S)]
        assert len(times) == pytest.approx(2000, rel=0.01)
        assert all(later - earlier >= S // 10 - 1 for earlier, later in zip(times, times[11:], strict=False))

    def test_a_query_is_answered_with_everything_once(self) -> None:
        discovery = Discovery("PC1", ME, rate=1000, burst=10)
        for n in range(100):
            discovery.advertise(0, f"t{n}", 1)
        discovery.link_up(0)
        run(discovery, 0, 10 * S)
        for n in range(50):
            hear(discovery, 10 * S, m.Hello(f"PC{n}", n, m.HELLO_QUERY), source=n)
        said = [message for _, event in run(discovery, 10 * S, 10 * S + 300 * MS) for message in sent([event])]
        advertised = [message.topic for message in said if isinstance(message, m.Advertise)]
        assert set(advertised) == {f"t{n}" for n in range(100)}
        assert len(advertised) <= 125
        hellos = [message for message in said if isinstance(message, m.Hello)]
        assert 1 <= len(hellos) <= 4
        assert not any(message.flags & m.HELLO_QUERY for message in hellos)

    def test_a_tool_asks(self) -> None:
        discovery = started(observer=True)
        assert sent(discovery.query(SOON)) == [own_hello(m.HELLO_QUERY | m.HELLO_TOOL)]

    def test_a_quiet_line_is_waited_for_but_not_for_ever(self) -> None:
        discovery = started(quiet=0.033)
        step = discovery.next_deadline()
        assert step is not None
        hear(discovery, step - 40 * MS, m.Alive("IMU1"))
        assert discovery.next_deadline() == step
        hear(discovery, step - 10 * MS, m.Alive("IMU1"))
        assert discovery.next_deadline() == step + 23 * MS
        for late in range(0, 2000, 20):
            hear(discovery, step + late * MS, m.Alive("IMU1"))
        assert discovery.next_deadline() == step + 1000 * MS

    def test_a_quiet_line_is_not_waited_for_with_what_is_new(self) -> None:
        discovery = started(quiet=0.033)
        assert sent(hear(discovery, SOON, m.Advertise("cmd", 12))) == [m.SubscribeRequest("cmd", 12, 5)]
        assert sent(discovery.subscribe(SOON, "new", 5)) == [m.SubscribeRequest("new", 5, 5)]

    def test_presence_is_not_drowned_by_ten_thousand_topics(self) -> None:
        discovery = Discovery("PC1", ME)
        for n in range(10_000):
            discovery.advertise(0, f"t{n}", 1)
        discovery.link_up(0)
        hear(discovery, 0, PC2)
        said = [(now, message) for now, event in run(discovery, 0, 90 * S) for message in sent([event])]
        hellos = [now for now, message in said if isinstance(message, m.Hello)]
        assert max(later - earlier for earlier, later in itertools.pairwise(hellos)) < 1.6 * S
        assert len({message.topic for _, message in said if isinstance(message, m.Advertise)}) == 10_000

    def test_polling_costs_what_is_sent_however_much_there_is(self) -> None:
        discovery = Discovery("PC1", ME)
        for n in range(10_000):
            discovery.advertise(0, f"t{n}", 1)
            discovery.withdraw(0, f"t{n}")
        discovery.link_up(0)
        assert len(discovery.poll(0)) == 0
        assert discovery.next_deadline() == S // 2


class TestHostile:
    @pytest.mark.parametrize(
        ("data", "reason"),
        [
            (b"", "undecodable"),
            (bytes(31), "undecodable"),
            (bytes(31) + b"\x11", "undecodable"),
            (b"\xff" * 31 + b"\x22", "undecodable"),
            (bytes(31) + b"\x7f", "unknown type"),
            (b"\x09" + bytes(30) + b"\x50", "unknown type"),
        ],
    )
    def test_what_is_no_message_is_counted(self, data: bytes, reason: str) -> None:
        discovery = started()
        assert discovery.receive(S, data) == []
        assert discovery.counts == {reason: 1}

    def test_tables_are_bounded(self) -> None:
        discovery = started()
        discovery.limit_tables(10)
        demand = discovery.demand()
        events: list[Event] = []
        for n in range(30):
            flood: list[m.Management] = [m.Hello(f"x{n}", n), m.Advertise(f"t{n}", 1), m.Endpoint(1, n, "n", f"t{n}")]
            events += hear(discovery, S + n, *flood, source=n)
        assert len(discovery.modules) == len(discovery.topics) == len(discovery.endpoints) == 10
        assert "x29" in discovery.modules
        assert [event for event in events if isinstance(event, TableFull)] == [TableFull(10)]
        assert sum(isinstance(event, ModuleGone) for event in events) == 20
        assert discovery.counts["modules forgotten"] == 20
        assert discovery.counts["topics forgotten"] == discovery.counts["topics not forwarded"] == 20
        assert len(demand.topics()) == 10
        run(discovery, S, 60 * S)
        assert not discovery.modules
        assert not discovery.endpoints

    def test_addresses_are_bounded(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("r2p.protocols.discovery.negotiation.PEERS_MAX", 10)
        discovery = started()
        assert [joined(discovery, S, source=n) for n in range(12)] == [True] * 10 + [False] * 2
        assert discovery.counts["too many peers"] == 2

    def test_addresses_that_left_make_room(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("r2p.protocols.discovery.negotiation.PEERS_MAX", 10)
        discovery = started()
        for n in range(50):
            now = S + n * 6 * S
            hear(discovery, now, m.Hello(f"x{n}", n), REQUEST, source=n)
            run(discovery, now, now + 6 * S)
            hear(discovery, now + 6 * S - 1, m.Hello(f"x{n}", n, m.HELLO_LEAVING), source=n)
        assert not discovery.counts["too many peers"]
