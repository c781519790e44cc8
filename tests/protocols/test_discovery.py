"""Each rule of the management protocol by itself, with its times."""

import itertools

import pytest

from r2p.codecs import management as m
from r2p.protocols import directory
from r2p.protocols.discovery import (
    Command,
    Discovery,
    Echoes,
    Event,
    Joined,
    Left,
    Mismatched,
    ModuleChanged,
    ModuleGone,
    NameConflict,
    Obey,
    Opened,
    Send,
    Shape,
    Shut,
)
from tests.protocols.wire import MS, S, hear, news, run, sent

ONE = b"\x01" * 8
TWO = b"\x02" * 8
ME, PEER = 0x1111, 0x2222
SOON = 200 * MS
"""Before the next step of what is repeated."""
PC2 = m.Hello("PC2", PEER)
REQUEST = m.SubscribeRequest("leds", 5, 8)
RESPONSE = m.SubscribeResponse("cmd", 12)


def started(**options: object) -> Discovery:
    """A module that publishes `leds` and subscribes `cmd`, 100 ms after its link went up."""
    discovery = Discovery("PC1", ME, **options)  # type: ignore[arg-type]
    discovery.advertise(0, "leds", 5, ONE)
    discovery.subscribe(0, "cmd", 12, 5, TWO)
    discovery.link_up(0)
    run(discovery, 0, 100 * MS)
    return discovery


def joined(discovery: Discovery, now: int, source: object = None) -> bool:
    return any(isinstance(event, Joined) for event in hear(discovery, now, REQUEST, source=source))


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
            m.Hello("PC1", ME, m.HELLO_QUERY),
            m.Alive("PC1", m.FLAG_STOPPED),
            m.Advertise("leds", 5, 0, b"\x28\x18" + bytes(8)),
            m.SubscribeRequest("cmd", 12, 5),
        ]

    def test_a_tool_is_no_module(self) -> None:
        discovery = Discovery("_x1y2z3", ME, observer=True)
        assert sent(discovery.link_up(0)) == [m.Hello("_x1y2z3", ME, m.HELLO_QUERY | m.HELLO_TOOL)]
        assert {type(message) for _, event in run(discovery, 0, 9 * S) for message in sent([event])} == {m.Hello}

    def test_what_is_new_is_announced_at_once(self) -> None:
        discovery = started()
        assert sent(discovery.advertise(SOON, "odometry", 20)) == [m.Advertise("odometry", 20)]
        assert sent(discovery.subscribe(SOON, "pose")) == [m.SubscribeRequest("pose", 0, 16)]
        assert sent(discovery.set_flags(SOON, m.FLAG_STOPPED))[1:] == [m.Alive("PC1", m.FLAG_STOPPED)]
        assert sent(discovery.advertise(SOON, "odometry", 20)) == []
        assert sent(discovery.set_flags(SOON, m.FLAG_STOPPED)) == []

    @pytest.mark.parametrize(("queue", "told"), [(0, 1), (1, 1), (70000, 0xFFFF)])
    def test_a_queue_of_zero_would_halt_firmware(self, queue: int, told: int) -> None:
        discovery = started()
        assert sent(discovery.subscribe(SOON, "pose", 20, queue)) == [m.SubscribeRequest("pose", 20, told)]

    def test_good_bye_is_the_last_word(self) -> None:
        discovery = started()
        assert sent(discovery.leave(S)) == [m.Hello("PC1", ME, m.HELLO_LEAVING)]
        assert hear(discovery, S, REQUEST) == []
        assert discovery.next_deadline() is None
        assert discovery.counts["link down"] == 1


class TestHandshake:
    def test_request_is_answered_every_time_but_joins_once(self) -> None:
        discovery = started()
        params = b"\xaa" * 10
        first = hear(discovery, S, m.SubscribeRequest("leds", 99, 8, params))
        assert sent(first) == [m.SubscribeResponse("leds", 5, 8)]
        assert news(first) == [Joined("leds", params, 8)]
        again = hear(discovery, S, m.SubscribeRequest("leds", 5, 0 + 3))
        assert sent(again) == [m.SubscribeResponse("leds", 5, 3)]
        assert news(again) == []

    def test_the_answer_goes_before_the_latched_value(self) -> None:
        assert isinstance(hear(started(), S, REQUEST)[0], Send)

    def test_advertise_is_answered_every_time(self) -> None:
        discovery = started()
        for now in (S, 2 * S):
            assert hear(discovery, now, m.Advertise("cmd", 12)) == [Send(m.encode(m.SubscribeRequest("cmd", 12, 5)))]

    def test_response_opens_once_until_the_parameters_change(self) -> None:
        discovery = started()
        assert hear(discovery, S, RESPONSE) == [Opened("cmd", None, bytes(10), 12)]
        assert hear(discovery, S, RESPONSE) == []
        other = b"\x56\x34" + bytes(8)
        assert hear(discovery, S, m.SubscribeResponse("cmd", 12, 5, other)) == [Opened("cmd", None, other, 12)]

    @pytest.mark.parametrize(
        "message",
        [
            m.Advertise("leds", 5),
            m.SubscribeRequest("cmd", 12, 1),
            m.SubscribeResponse("leds", 5),
            m.Advertise("nobodys", 5),
            m.SubscribeRequest("nobodys", 5, 1),
            m.SubscribeResponse("nobodys", 5),
            m.TypeInfo(m.ROLE_PUBLISHES, "nobodys", ONE, 5),
            m.TypeInfo(7, "leds", ONE, 5),
            m.Path("IMU1", "node", "leds"),
        ],
    )
    def test_what_does_not_concern_us_has_no_answer(self, message: m.Management) -> None:
        assert hear(started(), S, message) == []

    @pytest.mark.parametrize("message", [m.Advertise("cmd", 8), m.SubscribeResponse("cmd", 8)])
    def test_another_size_is_refused_and_told_once(self, message: m.Management) -> None:
        discovery = started()
        ours, theirs = Shape(12, TWO), Shape(8)
        expected = Mismatched("cmd", None, m.ROLE_PUBLISHES, ours, theirs)
        assert hear(discovery, S, message, message) == [expected]
        assert discovery.topics["cmd"].mismatch
        assert hear(discovery, S, RESPONSE) == [Opened("cmd", None, bytes(10), 12)]
        assert not discovery.topics["cmd"].mismatch
        assert hear(discovery, S, message) == [expected, Shut("cmd", None)]

    def test_a_size_that_nobody_knows_fits(self) -> None:
        discovery = started()
        discovery.subscribe(S, "any")
        assert hear(discovery, S, m.SubscribeResponse("any", 7), m.SubscribeResponse("cmd", 0)) == [
            Opened("any", None, bytes(10), 7),
            Opened("cmd", None, bytes(10), 0),
        ]

    def test_sources_of_a_bus_are_told_apart(self) -> None:
        discovery = started()
        assert joined(discovery, S, source=0x28)
        assert joined(discovery, S, source=0x29)
        assert not joined(discovery, S, source=0x28)
        assert news(discovery.withdraw(S, "leds")) == [Left("leds")]

    def test_withdrawn_and_back_starts_afresh(self) -> None:
        discovery = started()
        hear(discovery, S, REQUEST, RESPONSE)
        assert news(discovery.withdraw(S, "leds")) == [Left("leds")]
        assert news(discovery.unsubscribe(S, "cmd")) == [Shut("cmd", None)]
        assert hear(discovery, S, REQUEST, RESPONSE) == []
        discovery.advertise(S, "leds", 5)
        assert joined(discovery, S)


class TestLeases:
    def test_firmware_subscribes_for_ever_also_across_a_reconnect(self) -> None:
        discovery = started()
        assert joined(discovery, S)
        assert all(isinstance(event, Send) for _, event in run(discovery, S, 3600 * S))
        assert discovery.link_down(3600 * S) == []
        discovery.link_up(3601 * S)
        assert joined(discovery, 3601 * S), "after a gap the latched value is due again"
        assert not joined(discovery, 3602 * S)

    @pytest.mark.parametrize(("lease_ms", "ns"), [(100, 5 * S), (5000, 5 * S), (12000, 12 * S)])
    def test_r2p_subscribes_for_a_while(self, lease_ms: int, ns: int) -> None:
        discovery = started()
        hear(discovery, S, m.Hello("PC2", PEER, lease_ms=lease_ms))
        assert joined(discovery, S + 1)
        hear(discovery, 2 * S, m.Hello("PC2", PEER, lease_ms=lease_ms))
        ends = [(now, event) for now, event in run(discovery, S, 30 * S) if isinstance(event, Left)]
        assert ends == [(S + 1 + ns, Left("leds"))]

    def test_repeating_keeps_the_lease(self) -> None:
        discovery = started()
        for now in range(S, 30 * S, 4 * S):
            hear(discovery, now, PC2, REQUEST)
            assert not news(event for _, event in run(discovery, now, now + 4 * S))

    def test_a_hello_turns_what_came_before_it_into_leases(self) -> None:
        discovery = started()
        assert joined(discovery, S)
        hear(discovery, 9 * S, PC2)
        assert not joined(discovery, 10 * S), "it was only late"
        gone = [(now, event) for now, event in run(discovery, 10 * S, 60 * S) if isinstance(event, Left)]
        assert gone == [(14 * S, Left("leds"))]

    def test_a_hello_through_a_gateway_makes_no_leases(self) -> None:
        discovery = started()
        assert joined(discovery, S)
        hear(discovery, S, m.Hello("PC2", PEER, hops=1))
        lost = [event for _, event in run(discovery, S, 60 * S) if not isinstance(event, Send)]
        assert [type(event) for event in lost] == [ModuleGone]

    def test_good_bye_ends_everything_at_once(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, REQUEST, RESPONSE)
        info = discovery.modules["PC2"]
        leaving = m.Hello("PC2", PEER, m.HELLO_LEAVING)
        assert hear(discovery, 2 * S, leaving) == [ModuleGone(info), Left("leds"), Shut("cmd", None)]
        assert hear(discovery, 2 * S, leaving) == []
        assert discovery.modules == {}

    def test_a_late_request_of_one_who_left_is_a_lease(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, m.Hello("PC2", PEER, m.HELLO_LEAVING))
        assert joined(discovery, 2 * S)
        assert Left("leds") in [event for _, event in run(discovery, 2 * S, 8 * S)]

    def test_good_bye_of_an_earlier_start_means_nothing(self) -> None:
        discovery = started()
        hear(discovery, S, m.Hello("PC2", 7), PC2, REQUEST)
        assert hear(discovery, S, m.Hello("PC2", 7, m.HELLO_LEAVING)) == []

    def test_good_bye_of_one_whose_hellos_were_lost(self) -> None:
        discovery = started()
        assert joined(discovery, S)
        assert hear(discovery, S, m.Hello("PC2", PEER, m.HELLO_LEAVING)) == [Left("leds")]

    def test_unsubscribe_ends_one_subscription(self) -> None:
        discovery = started()
        discovery.advertise(S, "log", 64)
        hear(discovery, S, PC2, REQUEST, m.SubscribeRequest("log", 64, 1))
        assert hear(discovery, S, m.Unsubscribe("leds", PEER)) == [Left("leds")]
        assert hear(discovery, S, m.Unsubscribe("leds", PEER)) == []
        assert hear(discovery, S, m.Unsubscribe("nobodys", PEER)) == []

    def test_nobody_unsubscribes_for_others(self) -> None:
        discovery = started()
        assert joined(discovery, S)
        assert hear(discovery, S, m.Unsubscribe("leds", PEER)) == []
        hear(discovery, S, PC2, m.Hello("PC3", 0x3333))
        assert hear(discovery, S, m.Unsubscribe("leds", PEER)) == []
        assert discovery.counts["unsubscribe left to the lease"] == 2

    def test_silence_ends_a_module_and_all_that_it_had(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, m.Alive("PC2"), RESPONSE, REQUEST)
        hear(discovery, 3 * S, m.Alive("PC2"), m.Alive("IMU1"))
        events = [(now, event) for now, event in run(discovery, 3 * S, 60 * S) if not isinstance(event, Send)]
        assert [(now, type(event)) for now, event in events] == [
            (6 * S, Left),
            (8 * S, ModuleGone),
            (8 * S, Shut),
        ]
        assert list(discovery.modules) == ["IMU1"], "firmware does not say how long to believe it"

    def test_link_down_ends_leases(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, REQUEST, m.Endpoint(1, PEER, "n", "log"))
        info = discovery.modules["PC2"]
        assert discovery.link_down(2 * S) == [ModuleGone(info), Left("leds")]
        assert discovery.modules == {}
        assert discovery.endpoints == {}
        assert run(discovery, 2 * S, 60 * S) == []

    def test_the_longest_lease_lasts_as_long_as_its_module(self) -> None:
        discovery = started()
        long = m.Hello("PC2", PEER, lease_ms=0xFFFF)
        hear(discovery, S, long, REQUEST)
        for now in range(S, 600 * S, 60 * S):
            hear(discovery, now, long)
            assert not [event for _, event in run(discovery, now, now + 60 * S) if isinstance(event, Left)]
        left = [event for _, event in run(discovery, 600 * S, 700 * S) if not isinstance(event, Send)]
        assert [type(event) for event in left] == [ModuleGone, Left]

    @pytest.mark.parametrize(("topics", "rate", "lease"), [(2, 250, 5000), (100, 10, 60600), (10_000, 250, 65535)])
    def test_our_own_lease_outlasts_our_round(self, topics: int, rate: float, lease: int) -> None:
        discovery = Discovery("PC1", ME, rate=rate)
        for n in range(topics):
            discovery.subscribe(0, f"t{n}", 1)
        hello = sent(discovery.link_up(0))[0]
        assert isinstance(hello, m.Hello)
        assert hello.lease_ms == lease


class TestTypes:
    def test_types_go_before_what_they_belong_to_but_only_to_r2p(self) -> None:
        discovery = started()
        hear(discovery, S, PC2)
        mine = [m.TypeInfo(m.ROLE_PUBLISHES, "leds", ONE, 5), m.TypeInfo(m.ROLE_SUBSCRIBES, "cmd", TWO, 12)]
        repeated = sent(discovery.poll(S))
        assert repeated[2:] == [mine[0], m.Advertise("leds", 5), mine[1], m.SubscribeRequest("cmd", 12, 5)]
        assert sent(hear(discovery, S, REQUEST)) == [mine[0], m.SubscribeResponse("leds", 5, 8)]
        assert sent(hear(discovery, S, m.Advertise("cmd", 12))) == [mine[1], m.SubscribeRequest("cmd", 12, 5)]
        assert sent(hear(discovery, S, REQUEST, source=0x28)) == [m.SubscribeResponse("leds", 5, 8)]

    def test_a_subscriber_of_another_type_is_refused(self) -> None:
        discovery = started()
        theirs = m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", TWO, 5)
        told = Mismatched("leds", None, m.ROLE_SUBSCRIBES, Shape(5, ONE), Shape(5, TWO))
        hear(discovery, S, PC2)
        assert hear(discovery, S, theirs) == [told]
        answer = hear(discovery, S, REQUEST, theirs, REQUEST)
        assert sent(answer) == [m.TypeInfo(m.ROLE_PUBLISHES, "leds", ONE, 5)] * 2
        assert news(answer) == []

    def test_a_publisher_of_another_type_is_refused(self) -> None:
        discovery = started()
        theirs = m.TypeInfo(m.ROLE_PUBLISHES, "cmd", ONE, 12)
        told = Mismatched("cmd", None, m.ROLE_PUBLISHES, Shape(12, TWO), Shape(12, ONE))
        hear(discovery, S, PC2)
        assert hear(discovery, S, theirs) == [told]
        answer = hear(discovery, S, m.Advertise("cmd", 12), RESPONSE)
        assert sent(answer) == [m.TypeInfo(m.ROLE_SUBSCRIBES, "cmd", TWO, 12)]
        assert news(answer) == []

    def test_a_late_type_undoes_what_was_done(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, REQUEST, RESPONSE)
        wrong = [m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", TWO, 5), m.TypeInfo(m.ROLE_PUBLISHES, "cmd", ONE, 12)]
        events = hear(discovery, S, *wrong)
        assert [type(event) for event in events] == [Mismatched, Left, Mismatched, Shut]

    def test_a_type_that_was_corrected_fits(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", TWO, 5), REQUEST)
        assert hear(discovery, S, m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", ONE, 5)) == []
        assert joined(discovery, S)

    def test_our_own_correction_counts_too(self) -> None:
        discovery = started()
        right = m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", ONE, 5)
        hear(discovery, S, PC2, right, REQUEST)
        assert [type(event) for event in news(discovery.advertise(S, "leds", 5, TWO))] == [Mismatched, Left]
        assert news(discovery.advertise(S, "leds", 5, ONE)) == []
        assert joined(discovery, S)

    @pytest.mark.parametrize("fingerprint", [m.ANY_TYPE, ONE])
    def test_any_type_fits_all(self, fingerprint: bytes) -> None:
        discovery = started()
        hear(discovery, S, PC2)
        size = 5 if fingerprint == ONE else 0
        assert news(hear(discovery, S, m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", fingerprint, size))) == []
        assert joined(discovery, S)

    def test_a_changed_type_is_told_again(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", TWO, 5))
        third = m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", b"\x03" * 8, 9)
        assert [type(event) for event in hear(discovery, S, third, third)] == [Mismatched]

    def test_unsubscribing_is_told_to_r2p_only(self) -> None:
        discovery = started()
        assert sent(discovery.unsubscribe(SOON, "cmd")) == []
        hear(discovery, SOON, PC2)
        discovery.poll(SOON)
        discovery.subscribe(SOON, "cmd", 12)
        assert sent(discovery.unsubscribe(SOON, "cmd")) == [m.Unsubscribe("cmd", ME)]


class TestModules:
    def test_a_module_is_told_when_it_is_new_or_different(self) -> None:
        discovery = started()
        assert hear(discovery, S, m.Alive("IMU1")) == [ModuleChanged(discovery.modules["IMU1"])]
        assert hear(discovery, 2 * S, m.Alive("IMU1")) == []
        assert discovery.modules["IMU1"].last_heard == 2 * S
        assert not discovery.modules["IMU1"].r2p
        assert hear(discovery, 3 * S, m.Alive("IMU1", 1)) == [ModuleChanged(discovery.modules["IMU1"])]
        hello = m.Hello("IMU1", PEER, m.HELLO_TOOL)
        assert hear(discovery, 4 * S, hello) == [ModuleChanged(discovery.modules["IMU1"])]
        info = discovery.modules["IMU1"]
        assert (info.flags, info.instance, info.observer, info.r2p) == (1, PEER, True, True)

    @pytest.mark.parametrize(
        ("before", "after", "again"),
        [(0, 2, True), (2, 0, True), (0, 6, True), (2, 4, True), (1, 0, True), (0, 1, False), (2, 3, False)],
    )
    def test_firmware_that_restarted_joins_again(self, before: int, after: int, again: bool) -> None:
        discovery = started()
        hear(discovery, S, m.Alive("IMU1", before))
        assert joined(discovery, S)
        hear(discovery, 2 * S, m.Alive("IMU1", after))
        assert joined(discovery, 3 * S) == again
        assert not joined(discovery, 3 * S)

    def test_r2p_that_restarted_joins_again(self) -> None:
        discovery = started()
        hear(discovery, S, PC2)
        assert joined(discovery, S)
        hear(discovery, 2 * S, m.Hello("PC2", PEER + 1))
        assert joined(discovery, 2 * S)
        assert not joined(discovery, 2 * S)

    def test_another_tool_on_the_same_line_joins_by_itself(self) -> None:
        discovery = started()
        hear(discovery, S, PC2)
        assert joined(discovery, S)
        hear(discovery, 2 * S, m.Hello("_tool02", 0x3333, m.HELLO_TOOL))
        assert joined(discovery, 2 * S)

    def test_a_module_that_moved_takes_its_subscriptions_along(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, REQUEST, source=1)
        assert Left("leds") in hear(discovery, S, PC2, source=2)
        assert joined(discovery, S, source=2)

    def test_orders_are_obeyed_by_the_one_they_name(self) -> None:
        discovery = started()
        orders: list[m.Management] = [
            m.Stop("PC1"),
            m.Reboot("PC1"),
            m.Bootload("PC1"),
            m.Stop("PC"),
            m.Stop("PC12"),
            m.Reboot("IMU1"),
        ]
        assert hear(discovery, S, *orders) == [Obey(Command.STOP), Obey(Command.REBOOT), Obey(Command.BOOTLOAD)]

    @pytest.mark.parametrize(
        ("command", "message"),
        [(Command.STOP, m.Stop), (Command.REBOOT, m.Reboot), (Command.BOOTLOAD, m.Bootload)],
    )
    def test_orders_are_urgent(self, command: Command, message: type[m.Stop]) -> None:
        assert started().command(SOON, command, "IMU1") == [Send(m.encode(message("IMU1")), urgent=True)]

    def test_endpoints_are_told_to_r2p_only(self) -> None:
        discovery = started()
        discovery.endpoint(S, "blink", "leds", m.ROLE_PUBLISHES, m.CLASS_SRT)
        assert not any(
            isinstance(message, m.Endpoint) for _, event in run(discovery, S, 9 * S) for message in sent([event])
        )
        hear(discovery, 9 * S, PC2)
        assert m.Endpoint(1, ME, "blink", "leds", m.CLASS_SRT) in sent(discovery.poll(9 * S))
        assert sent(discovery.endpoint(9 * S, "blink", "leds", 1, m.CLASS_HRT)) == [
            m.Endpoint(1, ME, "blink", "leds", m.CLASS_HRT)
        ]
        assert sent(discovery.endpoint_gone(9 * S, "blink", "leds", 1)) == [m.Endpoint(129, ME, "blink", "leds")]
        hear(discovery, 9 * S, m.Hello("PC2", PEER, m.HELLO_LEAVING))
        assert sent(discovery.endpoint(9 * S, "blink", "leds", 1)) == []

    def test_endpoints_are_learnt_and_forgotten(self) -> None:
        discovery = started()
        there = m.Endpoint(1, PEER, "blink", "leds", m.CLASS_NRT)
        hear(discovery, S, there)
        assert [info.module for info in discovery.endpoints.values()] == [""]
        hear(discovery, S, PC2, there)
        assert [info.module for info in discovery.endpoints.values()] == ["PC2"]
        hear(discovery, S, m.Endpoint(129, PEER, "blink", "leds"))
        assert discovery.endpoints == {}
        hear(discovery, S, there)
        hear(discovery, 5 * S, PC2)
        run(discovery, 5 * S, 6 * S + 1)
        assert discovery.endpoints == {}, "not repeated"
        hear(discovery, 7 * S, there, m.Hello("PC2", PEER, m.HELLO_LEAVING))
        assert discovery.endpoints == {}

    def test_topics_are_learnt(self) -> None:
        discovery = started()
        hear(discovery, S, m.TypeInfo(m.ROLE_SUBSCRIBES, "pose", ONE, 20), m.SubscribeRequest("pose", 20, 1))
        assert (discovery.topics["pose"].fingerprint, discovery.topics["pose"].requested_at) == (ONE, S)
        hear(discovery, 2 * S, m.TypeInfo(m.ROLE_PUBLISHES, "pose", TWO, 12), m.Advertise("pose", 12))
        info = discovery.topics["pose"]
        assert (info.size, info.fingerprint, info.advertised_at) == (12, TWO, 2 * S)


class TestNames:
    def test_a_namesake_is_told_every_five_seconds(self) -> None:
        discovery = started()
        told = [
            now
            for now in range(S, 14 * S, S)
            for event in hear(discovery, now, m.Hello("PC1", PEER), m.Alive("PC1"))
            if event == NameConflict("PC1", ME, PEER)
        ]
        assert told == [S, 6 * S, 11 * S]

    def test_a_namesake_of_firmware_has_no_instance(self) -> None:
        assert hear(started(), S, m.Alive("PC1")) == [NameConflict("PC1", ME, None)]

    def test_things_work_with_a_namesake_too(self) -> None:
        discovery = started()
        hear(discovery, S, m.Hello("PC1", PEER))
        assert joined(discovery, S)
        assert Left("leds") in [event for _, event in run(discovery, S, 9 * S)]

    def test_the_good_bye_of_our_predecessor_is_no_conflict(self) -> None:
        assert hear(started(), S, m.Hello("PC1", PEER, m.HELLO_LEAVING)) == []

    def test_two_others_that_share_a_name(self) -> None:
        discovery = started()
        hellos = [m.Hello("IMU1", 1), m.Hello("IMU1", 2)] * 4
        told = [event for event in hear(discovery, S, *hellos) if isinstance(event, NameConflict)]
        assert told == [NameConflict("IMU1", 2, 1)]

    def test_one_that_restarts_is_no_conflict(self) -> None:
        discovery = started()
        hellos = [m.Hello("IMU1", instance) for instance in (1, 2, 1, 2, 2, 3, 4, 3, 4, 4)]
        assert not any(isinstance(event, NameConflict) for event in hear(discovery, S, *hellos))

    def test_a_hub_that_hears_both_tells(self) -> None:
        hub = started()
        message = m.Conflict("IMU1", 1, 2)
        assert sent(hub.conflict(SOON, "IMU1", 1, 2)) == [message]
        one, other = Discovery("IMU1", 2), Discovery("IMU1", 3)
        one.link_up(0)
        other.link_up(0)
        assert hear(one, S, message) == [NameConflict("IMU1", 1, 2)]
        assert hear(other, S, message) == []

    def test_an_echo_is_no_namesake_and_no_peer(self) -> None:
        discovery = Discovery("PC1", ME)
        discovery.advertise(0, "both", 5)
        discovery.subscribe(0, "both", 5)
        said = [event.data for event in discovery.link_up(0) if isinstance(event, Send)]
        echoed = [event for data in said for event in discovery.receive(1, data)]
        assert echoed == [Echoes()]
        assert discovery.counts["echo"] == len(said) == 4
        assert discovery.modules == {}
        for now, event in run(discovery, 1, 60 * S):
            if isinstance(event, Send):
                assert news(discovery.receive(now, event.data)) in ([], [Echoes()])
        theirs = hear(discovery, 60 * S, m.SubscribeRequest("both", 5, 16), m.SubscribeRequest("both", 5, 16))
        assert news(theirs) == [Joined("both", bytes(10), 16)], "the same words from a peer count"


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
        assert sent(discovery.query(SOON)) == [m.Hello("PC1", ME, m.HELLO_QUERY | m.HELLO_TOOL)]

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
        assert sent(discovery.subscribe(SOON, "new")) == [m.SubscribeRequest("new", 0, 16)]

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

    def test_tables_are_bounded(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(directory, "MOST", 10)
        discovery = started()
        events: list[Event] = []
        for n in range(30):
            flood: list[m.Management] = [m.Hello(f"x{n}", n), m.Advertise(f"t{n}", 1), m.Endpoint(1, n, "n", f"t{n}")]
            events += hear(discovery, S + n, *flood, source=n)
        assert len(discovery.modules) == len(discovery.topics) == len(discovery.endpoints) == 10
        assert "x29" in discovery.modules
        assert sum(isinstance(event, ModuleGone) for event in events) == 20
        assert discovery.counts["modules forgotten"] == 20
        assert discovery.counts["topics forgotten"] == 20
        run(discovery, S, 60 * S)
        assert not discovery.modules
        assert not discovery.endpoints

    def test_addresses_are_bounded(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("r2p.protocols.peers.MOST", 10)
        discovery = started()
        assert [joined(discovery, S, source=n) for n in range(12)] == [True] * 10 + [False] * 2
        assert discovery.counts["too many peers"] == 2

    def test_addresses_that_left_make_room(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("r2p.protocols.peers.MOST", 10)
        discovery = started()
        for n in range(50):
            now = S + n * 6 * S
            hear(discovery, now, m.Hello(f"x{n}", n), REQUEST, source=n)
            run(discovery, now, now + 6 * S)
            hear(discovery, now + 6 * S - 1, m.Hello(f"x{n}", n, m.HELLO_LEAVING), source=n)
        assert not discovery.counts["too many peers"]
