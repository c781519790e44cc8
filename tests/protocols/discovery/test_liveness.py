"""Modules that come, restart, go, and share a name."""

import pytest

from r2p.codecs import management as m
from r2p.protocols.discovery.events import (
    Command,
    CommandReceived,
    EchoDetected,
    ModuleChanged,
    ModuleGone,
    NameConflict,
    Send,
    SubscriberJoined,
    SubscribersGone,
)
from r2p.protocols.discovery.negotiation import GRACE
from r2p.protocols.discovery.session import Discovery
from tests.protocols.discovery.wire import (
    ME,
    MS,
    ONE,
    PC2,
    PEER,
    REQUEST,
    SOON,
    TWO,
    S,
    changes_in,
    hear,
    joined,
    run,
    sent,
    started,
)


class TestModules:
    def test_a_module_is_reported_when_it_is_new_or_different(self) -> None:
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

    def test_a_hello_of_an_earlier_start_that_comes_late_changes_nothing(self) -> None:
        discovery = started()
        hear(discovery, S, m.Hello("PC2", PEER - 1), PC2)
        assert joined(discovery, S)
        hear(discovery, S, m.Hello("PC2", PEER - 1), PC2)
        assert not joined(discovery, S)

    def test_another_tool_on_the_same_line_joins_by_itself(self) -> None:
        discovery = started()
        hear(discovery, S, PC2)
        assert joined(discovery, S)
        hear(discovery, 2 * S, m.Hello("_tool02", 0x3333, m.HELLO_TOOL))
        assert joined(discovery, 2 * S)

    def test_a_module_that_moved_takes_its_subscriptions_along(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, REQUEST, source=1)
        assert SubscribersGone("leds") in hear(discovery, S, PC2, source=2)
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
        assert hear(discovery, S, *orders) == [
            CommandReceived(Command.STOP),
            CommandReceived(Command.REBOOT),
            CommandReceived(Command.BOOTLOAD),
        ]

    @pytest.mark.parametrize(
        ("command", "message"),
        [(Command.STOP, m.Stop), (Command.REBOOT, m.Reboot), (Command.BOOTLOAD, m.Bootload)],
    )
    def test_orders_are_urgent(self, command: Command, message: type[m.Stop]) -> None:
        assert started().command(SOON, command, "IMU1") == [Send(m.encode(message("IMU1")), urgent=True)]

    def test_only_r2p_modules_get_endpoints(self) -> None:
        discovery = started()
        discovery.add_endpoint(S, "blink", "leds", m.ROLE_PUBLISHES, m.CLASS_SRT)
        assert not any(
            isinstance(message, m.Endpoint) for _, event in run(discovery, S, 9 * S) for message in sent([event])
        )
        hear(discovery, 9 * S, PC2)
        assert m.Endpoint(1, ME, "blink", "leds", m.CLASS_SRT) in sent(discovery.poll(9 * S))
        assert sent(discovery.add_endpoint(9 * S, "blink", "leds", 1, m.CLASS_HRT)) == [
            m.Endpoint(1, ME, "blink", "leds", m.CLASS_HRT)
        ]
        assert sent(discovery.remove_endpoint(9 * S, "blink", "leds", 1)) == [m.Endpoint(129, ME, "blink", "leds")]
        hear(discovery, 9 * S, m.Hello("PC2", PEER, m.HELLO_LEAVING))
        assert sent(discovery.add_endpoint(9 * S, "blink", "leds", 1)) == []

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
        for now in range(S, 26 * S, 5 * S):
            hear(discovery, now, PC2)
            run(discovery, now, min(now + 5 * S, 21 * S))
        assert discovery.endpoints, "it is said seldom"
        run(discovery, 21 * S, 21 * S + 1)
        assert discovery.endpoints == {}, "not repeated"
        hear(discovery, 27 * S, there, m.Hello("PC2", PEER, m.HELLO_LEAVING))
        assert discovery.endpoints == {}

    def test_endpoints_of_a_stranger_are_forgotten_sooner(self) -> None:
        discovery = started()
        hear(discovery, S, m.Endpoint(1, PEER, "blink", "leds", m.CLASS_NRT))
        run(discovery, S, 6 * S)
        assert discovery.endpoints
        run(discovery, 6 * S, 6 * S + 1)
        assert not discovery.endpoints

    def test_topics_are_learnt(self) -> None:
        discovery = started()
        hear(discovery, S, m.TypeInfo(m.ROLE_SUBSCRIBES, "pose", ONE, 20), m.SubscribeRequest("pose", 20, 1))
        assert (discovery.topics["pose"].fingerprint, discovery.topics["pose"].requested_at) == (ONE, S)
        hear(discovery, 2 * S, m.TypeInfo(m.ROLE_PUBLISHES, "pose", TWO, 12), m.Advertise("pose", 12))
        info = discovery.topics["pose"]
        assert (info.size, info.fingerprint, info.advertised_at) == (12, TWO, 2 * S)


class TestNames:
    def test_a_namesake_is_reported_every_five_seconds(self) -> None:
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
        assert SubscribersGone("leds") in [event for _, event in run(discovery, S, 9 * S)]

    def test_the_good_bye_of_our_predecessor_is_no_conflict(self) -> None:
        assert hear(started(), S, m.Hello("PC1", PEER, m.HELLO_LEAVING)) == []

    def test_two_others_that_share_a_name(self) -> None:
        discovery = started()
        hellos = [m.Hello("IMU1", 1), m.Hello("IMU1", 2)] * 4
        told = [event for event in hear(discovery, S, *hellos) if isinstance(event, NameConflict)]
        assert told == [NameConflict("IMU1", 2, 1)]

    def test_what_changed_long_ago_is_no_conflict(self) -> None:
        discovery = started()
        events = [each for n in range(8) for each in hear(discovery, S + 6 * n * S, m.Hello("IMU1", n % 2))]
        assert not any(isinstance(event, NameConflict) for event in events)

    def test_one_that_restarts_is_no_conflict(self) -> None:
        discovery = started()
        hellos = [m.Hello("IMU1", instance) for instance in (1, 2, 1, 2, 2, 3, 4, 3, 4, 4)]
        assert not any(isinstance(event, NameConflict) for event in hear(discovery, S, *hellos))

    def test_a_hub_that_hears_both_reports_them(self) -> None:
        hub = started()
        message = m.Conflict("IMU1", 1, 2)
        assert sent(hub.report_conflict(SOON, "IMU1", 1, 2)) == [message]
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
        assert echoed == [EchoDetected()]
        assert discovery.counts["echo"] == len(said) == 4
        assert discovery.modules == {}
        for now, event in run(discovery, 1, 60 * S):
            if isinstance(event, Send):
                assert changes_in(discovery.receive(now, event.data)) in ([], [EchoDetected()])
        theirs = hear(discovery, 60 * S, m.SubscribeRequest("both", 5, 5), m.SubscribeRequest("both", 5, 5))
        theirs += discovery.poll(60 * S + GRACE)
        assert changes_in(theirs) == [SubscriberJoined("both", bytes(10), 5)], "the same words from a peer count"


def test_endpoints_that_are_forgotten_leave_no_timer() -> None:
    discovery = Discovery("A", 1)
    discovery.limit_tables(100)
    discovery.link_up(0)
    discovery.receive(0, m.encode(m.Hello("B", 2)))
    for number in range(300):
        topic = f"t{number}"
        endpoint = m.Endpoint(m.ROLE_PUBLISHES, 2, "n", topic, m.CLASS_NRT)
        discovery.receive(number, m.encode(endpoint))
    assert len(discovery.endpoints) == 100
    assert len(discovery._timers._due) <= 108


def test_a_last_start_that_gateways_still_announce_is_not_a_namesake() -> None:
    """Neither of ours, nor of a module that is nearer."""
    discovery = started()
    hear(discovery, S, PC2)
    assert joined(discovery, S)
    last_starts = [m.Hello(name, 77, flags, 1) for name in ("PC1", "PC2") for flags in (0, m.HELLO_LEAVING)]
    assert changes_in(hear(discovery, 2 * S, *last_starts)) == []
    assert discovery.modules["PC2"].instance == PEER
    assert not joined(discovery, 3 * S)


def test_a_suspended_program_takes_no_module_for_gone() -> None:
    """What the others said meanwhile is still to be read; only who says nothing from then on is gone."""
    a = Discovery("A", 1)
    a.link_up(0)
    for number, name in enumerate(("ALIVE", "DEAD"), 2):
        hear(a, 0, m.Hello(name, number))
    woken = 60 * S
    assert not any(isinstance(each, ModuleGone) for each in a.poll(woken))
    hear(a, woken + MS, m.Hello("ALIVE", 2))
    gone = [(at, event.info.name) for at, event in run(a, woken, woken + 4 * S) if isinstance(event, ModuleGone)]
    assert gone == [(woken + 2 * S, "DEAD")]
