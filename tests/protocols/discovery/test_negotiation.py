"""Handshakes, leases and types: who may exchange what, rule by rule."""

import pytest

from r2p.codecs import management as m
from r2p.protocols.discovery.events import (
    Event,
    Mismatched,
    ModuleGone,
    PublisherFound,
    PublisherGone,
    Send,
    SubscriberJoined,
    SubscribersGone,
    TopicType,
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
    RESPONSE,
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


class TestHandshake:
    def test_request_is_answered_every_time_but_joins_once(self) -> None:
        discovery = started()
        params = b"\xaa" * 10
        first = hear(discovery, S, m.SubscribeRequest("leds", 99, 8, params))
        assert sent(first) == [m.SubscribeResponse("leds", 5, 8)]
        assert changes_in(first) == []
        assert changes_in(discovery.poll(S + GRACE)) == [SubscriberJoined("leds", params, 8)]
        again = hear(discovery, S, m.SubscribeRequest("leds", 5, 0 + 3))
        assert sent(again) == [m.SubscribeResponse("leds", 5, 3)]
        assert changes_in(again) == []

    def test_the_answer_goes_before_the_latched_value(self) -> None:
        assert isinstance(hear(started(), S, REQUEST)[0], Send)

    def test_advertise_is_answered_every_time(self) -> None:
        discovery = started()
        for now in (S, 2 * S):
            assert hear(discovery, now, m.Advertise("cmd", 12)) == [Send(m.encode(m.SubscribeRequest("cmd", 12, 5)))]

    def test_response_opens_once_until_the_parameters_change(self) -> None:
        discovery = started()
        assert hear(discovery, S, RESPONSE) == [PublisherFound("cmd", None, bytes(10), 12)]
        assert hear(discovery, S, RESPONSE) == []
        other = b"\x56\x34" + bytes(8)
        assert hear(discovery, S, m.SubscribeResponse("cmd", 12, 5, other)) == [PublisherFound("cmd", None, other, 12)]

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
    def test_another_size_is_refused_and_reported_once(self, message: m.Management) -> None:
        discovery = started()
        ours, theirs = TopicType(12, TWO), TopicType(8)
        expected = Mismatched("cmd", None, m.ROLE_PUBLISHES, ours, theirs)
        assert hear(discovery, S, message, message) == [expected]
        assert discovery.topics["cmd"].mismatch
        assert hear(discovery, S, RESPONSE) == [PublisherFound("cmd", None, bytes(10), 12)]
        assert not discovery.topics["cmd"].mismatch
        assert hear(discovery, S, message) == [expected, PublisherGone("cmd", None)]

    def test_an_unknown_size_fits(self) -> None:
        discovery = started()
        discovery.subscribe(S, "any")
        assert hear(discovery, S, m.SubscribeResponse("any", 7), m.SubscribeResponse("cmd", 0)) == [
            PublisherFound("any", None, bytes(10), 7),
            PublisherFound("cmd", None, bytes(10), 0),
        ]

    def test_sources_of_a_bus_are_told_apart(self) -> None:
        discovery = started()
        assert joined(discovery, S, source=0x28)
        assert joined(discovery, S, source=0x29)
        assert not joined(discovery, S, source=0x28)
        assert changes_in(discovery.withdraw(S, "leds")) == [SubscribersGone("leds")]

    def test_withdrawn_and_back_starts_afresh(self) -> None:
        discovery = started()
        assert joined(discovery, S)
        hear(discovery, S, RESPONSE)
        assert changes_in(discovery.withdraw(S, "leds")) == [SubscribersGone("leds")]
        assert changes_in(discovery.unsubscribe(S, "cmd")) == [PublisherGone("cmd", None)]
        assert hear(discovery, S, REQUEST, RESPONSE) == []
        discovery.advertise(S, "leds", 5)
        assert joined(discovery, S)


class TestGrace:
    """Data that follow a SUBSCRIBE_RESPONSE too soon are lost at firmware: its management has the lowest priority."""

    def joins(self, discovery: Discovery, start: int) -> list[int]:
        return [now - start for now, event in run(discovery, start, start + S) if isinstance(event, SubscriberJoined)]

    def test_firmware_takes_the_response_before_the_data(self) -> None:
        discovery = started()
        assert changes_in(hear(discovery, S, REQUEST)) == []
        assert changes_in(hear(discovery, S + GRACE // 2, REQUEST)) == [], "a repeat"
        assert self.joins(discovery, S) == [GRACE]

    def test_after_a_restart_again(self) -> None:
        discovery = started()
        hear(discovery, S, m.Alive("IMU1"))
        assert joined(discovery, S)
        hear(discovery, 2 * S, m.Alive("IMU1", m.FLAG_REBOOTED))
        assert changes_in(hear(discovery, 3 * S, REQUEST)) == []
        assert self.joins(discovery, 3 * S) == [GRACE]

    def test_r2p_takes_both_at_once(self) -> None:
        discovery = started()
        hear(discovery, S, PC2)
        assert changes_in(hear(discovery, S, REQUEST)) == [SubscriberJoined("leds", bytes(10), 8)]

    @pytest.mark.parametrize("params", [m.UNANSWERED, m.ANSWERED])
    def test_what_only_r2p_sends_tells_it_from_firmware(self, params: bytes) -> None:
        """Its HELLO may have been lost."""
        assert changes_in(hear(started(), S, m.SubscribeRequest("leds", 5, 8, params))) == [
            SubscriberJoined("leds", params, 8)
        ]

    def test_who_leaves_before_its_data_never_joined(self) -> None:
        discovery = started()
        hear(discovery, S, REQUEST)
        assert changes_in(discovery.withdraw(S, "leds")) == []
        assert self.joins(discovery, S) == []
        discovery.advertise(2 * S, "leds", 5)
        assert changes_in(hear(discovery, 2 * S, REQUEST, source=2)) == []
        hear(discovery, 2 * S, PC2, REQUEST)
        leaving = hear(discovery, 2 * S, m.Hello("PC2", PEER, m.HELLO_LEAVING))
        assert not any(isinstance(event, SubscribersGone) for event in leaving), "firmware is still there"
        assert self.joins(discovery, 2 * S) == [GRACE]


class TestLeases:
    def test_firmware_subscribes_for_ever_also_across_a_reconnect(self) -> None:
        discovery = started()
        assert joined(discovery, S)
        assert all(isinstance(event, Send) for _, event in run(discovery, S, 3600 * S))
        assert discovery.link_down(3600 * S) == []
        discovery.link_up(3601 * S)
        assert joined(discovery, 3601 * S), "after a gap the latched value is due again"
        assert not joined(discovery, 3602 * S)

    def test_what_was_asked_before_a_gap_by_r2p_without_a_hello_ends_with_its_next_one(self) -> None:
        discovery = started()
        assert joined(discovery, S)  # its HELLO was lost
        discovery.link_down(2 * S)
        discovery.link_up(3 * S)
        assert SubscribersGone("leds") in hear(discovery, 3 * S, PC2)
        assert joined(discovery, 3 * S)

    def test_what_is_asked_after_a_gap_counts_also_before_the_hello(self) -> None:
        discovery = started()
        assert joined(discovery, S)
        discovery.link_down(2 * S)
        discovery.link_up(3 * S)
        assert joined(discovery, 3 * S)
        assert SubscribersGone("leds") not in hear(discovery, 3 * S, PC2)
        ends = [now for now, event in run(discovery, 3 * S, 30 * S) if isinstance(event, SubscribersGone)]
        assert ends == [8 * S], "a lease from now on"

    @pytest.mark.parametrize(("lease_ms", "ns"), [(100, 5 * S), (5000, 5 * S), (12000, 12 * S)])
    def test_r2p_subscribes_for_a_while(self, lease_ms: int, ns: int) -> None:
        discovery = started()
        hear(discovery, S, m.Hello("PC2", PEER, lease_ms=lease_ms))
        assert joined(discovery, S + 1)
        hear(discovery, 2 * S, m.Hello("PC2", PEER, lease_ms=lease_ms))
        ends = [(now, event) for now, event in run(discovery, S, 30 * S) if isinstance(event, SubscribersGone)]
        assert ends == [(S + 1 + ns, SubscribersGone("leds"))]

    def test_repeating_keeps_the_lease(self) -> None:
        discovery = started()
        for now in range(S, 30 * S, 4 * S):
            hear(discovery, now, PC2, REQUEST)
            assert not changes_in(event for _, event in run(discovery, now, now + 4 * S))

    def test_a_hello_turns_what_came_before_it_into_leases(self) -> None:
        discovery = started()
        assert joined(discovery, S)
        hear(discovery, 9 * S, PC2)
        assert not joined(discovery, 10 * S), "it was only late"
        gone = [(now, event) for now, event in run(discovery, 10 * S, 60 * S) if isinstance(event, SubscribersGone)]
        assert gone == [(14 * S, SubscribersGone("leds"))]

    def test_what_came_before_the_hello_is_not_repeated(self) -> None:
        discovery = started()
        assert joined(discovery, S)
        left: list[int] = []
        for now in range(9 * S, 30 * S, 3 * S):
            hear(discovery, now, PC2)
            left += [at for at, event in run(discovery, now, now + 3 * S) if isinstance(event, SubscribersGone)]
        assert left == [14 * S]

    def test_firmware_that_follows_r2p_on_a_line_subscribes_for_ever(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, m.Hello("PC2", PEER, m.HELLO_LEAVING))
        assert joined(discovery, 5 * S)
        run(discovery, 5 * S, 7 * S)
        assert not joined(discovery, 7 * S)
        assert not changes_in(event for _, event in run(discovery, 7 * S, 60 * S))

    def test_the_longest_lease_at_an_address_counts(self) -> None:
        discovery = started()
        hear(discovery, S, m.Hello("PC3", 0x3333, lease_ms=12000), PC2, REQUEST)
        hear(discovery, 5 * S, m.Hello("PC3", 0x3333, lease_ms=12000), PC2)
        assert [now for now, event in run(discovery, 5 * S, 60 * S) if isinstance(event, SubscribersGone)] == [13 * S]

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
        assert hear(discovery, 2 * S, leaving) == [
            ModuleGone(info),
            SubscribersGone("leds"),
            PublisherGone("cmd", None),
        ]
        assert hear(discovery, 2 * S, leaving) == []
        assert discovery.modules == {}

    def test_a_late_request_of_one_who_left_is_a_lease(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, m.Hello("PC2", PEER, m.HELLO_LEAVING))
        assert joined(discovery, 2 * S)
        assert SubscribersGone("leds") in [event for _, event in run(discovery, 2 * S, 8 * S)]

    def test_good_bye_of_an_earlier_start_means_nothing(self) -> None:
        discovery = started()
        hear(discovery, S, m.Hello("PC2", 7), PC2, REQUEST)
        assert hear(discovery, S, m.Hello("PC2", 7, m.HELLO_LEAVING)) == []

    def test_good_bye_of_one_whose_hellos_were_lost(self) -> None:
        discovery = started()
        assert joined(discovery, S)
        assert hear(discovery, S, m.Hello("PC2", PEER, m.HELLO_LEAVING)) == [SubscribersGone("leds")]

    def test_unsubscribe_ends_one_subscription(self) -> None:
        discovery = started()
        discovery.advertise(S, "log", 64)
        hear(discovery, S, PC2, REQUEST, m.SubscribeRequest("log", 64, 1))
        assert hear(discovery, S, m.Unsubscribe("leds", PEER)) == [SubscribersGone("leds")]
        assert hear(discovery, S, m.Unsubscribe("leds", PEER)) == []
        assert hear(discovery, S, m.Unsubscribe("nobodys", PEER)) == []

    def test_a_module_can_not_unsubscribe_for_others(self) -> None:
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
            (6 * S, SubscribersGone),
            (8 * S, ModuleGone),
            (8 * S, PublisherGone),
        ]
        assert [event.silent for _, event in events if isinstance(event, ModuleGone)] == [True]
        assert list(discovery.modules) == ["IMU1"], "firmware does not say how long to believe it"

    def test_link_down_ends_leases(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, REQUEST, m.Endpoint(1, PEER, "n", "log"))
        info = discovery.modules["PC2"]
        assert discovery.link_down(2 * S) == [ModuleGone(info), SubscribersGone("leds")]
        assert discovery.modules == {}
        assert discovery.endpoints == {}
        assert run(discovery, 2 * S, 60 * S) == []

    def test_the_longest_lease_lasts_as_long_as_its_module(self) -> None:
        discovery = started()
        long = m.Hello("PC2", PEER, lease_ms=0xFFFF)
        hear(discovery, S, long, REQUEST)
        for now in range(S, 600 * S, 60 * S):
            hear(discovery, now, long)
            assert not [event for _, event in run(discovery, now, now + 60 * S) if isinstance(event, SubscribersGone)]
        left = [event for _, event in run(discovery, 600 * S, 700 * S) if not isinstance(event, Send)]
        assert [type(event) for event in left] == [ModuleGone, SubscribersGone]

    @pytest.mark.parametrize(("topics", "rate", "lease"), [(2, 250, 5000), (100, 10, 60600), (10_000, 250, 65535)])
    def test_our_own_lease_outlasts_our_round(self, topics: int, rate: float, lease: int) -> None:
        discovery = Discovery("PC1", ME, rate=rate)
        for n in range(topics):
            discovery.subscribe(0, f"t{n}", 1)
        hello = sent(discovery.link_up(0))[0]
        assert isinstance(hello, m.Hello)
        assert hello.lease_ms == lease


class TestLostAnswers:
    UNANSWERED = m.SubscribeRequest("leds", 5, 8, m.UNANSWERED)

    def joins(self, discovery: Discovery, now: int) -> bool:
        return any(isinstance(event, SubscriberJoined) for event in hear(discovery, now, self.UNANSWERED))

    def test_r2p_that_has_heard_no_answer_joins_again(self) -> None:
        discovery = started()
        hear(discovery, S, PC2)
        assert self.joins(discovery, S)
        assert not self.joins(discovery, S + SOON), "the answer may be on its way"
        assert self.joins(discovery, 3 * S)
        assert not joined(discovery, 5 * S)

    def test_firmware_never_does(self) -> None:
        discovery = started()
        assert self.joins(discovery, S)
        assert not self.joins(discovery, 3 * S)

    def test_a_request_says_whether_it_was_answered(self) -> None:
        discovery = started()
        plain = m.SubscribeRequest("cmd", 12, 5)
        assert sent(hear(discovery, S, m.Advertise("cmd", 12))) == [plain], "firmware is told nothing"
        hear(discovery, S, PC2)
        unanswered = m.SubscribeRequest("cmd", 12, 5, m.UNANSWERED)
        assert sent(hear(discovery, S, m.Advertise("cmd", 12)))[-1] == unanswered
        hear(discovery, S, RESPONSE)
        answered = m.SubscribeRequest("cmd", 12, 5, m.ANSWERED)
        assert sent(hear(discovery, S, m.Advertise("cmd", 12, 0, m.UNANSWERED)))[-1] == answered
        discovery.unsubscribe(S, "cmd")
        discovery.subscribe(S, "cmd", 12, 5)
        assert sent(hear(discovery, S, m.Advertise("cmd", 12)))[-1] == unanswered

    def test_a_publisher_that_left_has_answered_no_more(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, RESPONSE, m.Hello("PC2", PEER, m.HELLO_LEAVING))
        hear(discovery, S, m.Hello("PC2", PEER + 1))
        assert sent(hear(discovery, S, m.Advertise("cmd", 12)))[-1] == m.SubscribeRequest("cmd", 12, 5, m.UNANSWERED)


class TestRepeats:
    """Both sides of a subscription between r2p modules repeat themselves: neither has to answer all of the other's."""

    def test_what_flows_already_is_not_asked_for_again(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, RESPONSE)
        assert not sent(hear(discovery, S, m.Advertise("cmd", 12)))

    def test_a_publisher_without_subscribers_is_asked_at_once(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, RESPONSE)
        answered = m.SubscribeRequest("cmd", 12, 5, m.ANSWERED)
        assert sent(hear(discovery, S, m.Advertise("cmd", 12, 0, m.UNANSWERED)))[-1] == answered

    def test_another_address_of_the_data_is_asked_for(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, RESPONSE)
        assert sent(hear(discovery, S, m.Advertise("cmd", 12, 0, b"\x42".ljust(10, b"\0"))))

    def test_firmware_is_always_answered(self) -> None:
        discovery = started()
        hear(discovery, S, RESPONSE, REQUEST)
        assert sent(hear(discovery, S, m.Advertise("cmd", 12))) == [m.SubscribeRequest("cmd", 12, 5)]
        assert sent(hear(discovery, S, REQUEST)) == [m.SubscribeResponse("leds", 5, 8)]

    def test_an_advertisement_says_whether_it_has_subscribers(self) -> None:
        discovery = started()
        hear(discovery, S, PC2)

        def told(now: int) -> list[bytes]:
            sayings = [event.data for _, event in run(discovery, now, now + 2 * S) if isinstance(event, Send)]
            return [each.params for each in map(m.decode, sayings) if isinstance(each, m.Advertise)]

        assert set(told(S)) == {m.UNANSWERED}
        hear(discovery, 3 * S, PC2, REQUEST)
        assert set(told(3 * S)) == {m.NO_PARAMS}
        hear(discovery, 5 * S, m.Unsubscribe("leds", PEER))
        assert set(told(5 * S)) == {m.UNANSWERED}


class TestShared:
    """On a bus everybody hears an answer: where many ask at once, they share one."""

    PEERS = range(30)

    def beside_many(self) -> Discovery:
        discovery = started()
        for n in self.PEERS:
            hear(discovery, S, m.Hello(f"M{n}", n), source=n)
        run(discovery, S, 3 * S)
        return discovery

    def answers(self, discovery: Discovery, now: int, kind: type[m.Management]) -> list[int]:
        later = [(at, event) for at, event in run(discovery, now, now + 2 * S) if isinstance(event, Send)]
        return [at - now for at, event in later if isinstance(m.decode(event.data), kind)]

    def test_many_subscribers_share_responses(self) -> None:
        discovery = self.beside_many()
        events: list[Event] = []
        for n in self.PEERS:
            events += hear(discovery, 3 * S, REQUEST, source=n)
        said = [event for event in sent(events) if isinstance(event, m.SubscribeResponse)]
        assert len(said) == 3
        assert sum(isinstance(event, SubscriberJoined) for event in events) == 3
        later = [event for _, event in run(discovery, 3 * S, 5 * S)]
        responses = [isinstance(event, Send) and event.data[-1] == 0x23 for event in later]
        assert sum(responses) == 1
        joined_at = [at for at, event in enumerate(later) if isinstance(event, SubscriberJoined)]
        assert len(joined_at) == 27
        assert min(joined_at) > responses.index(True), "a latched value would find nobody"

    def test_many_publishers_share_requests(self) -> None:
        discovery = self.beside_many()
        said: list[m.Management] = []
        for n in self.PEERS:
            said += sent(hear(discovery, 3 * S, m.Advertise("cmd", 12, 0, m.UNANSWERED), source=n))
        assert sum(isinstance(event, m.SubscribeRequest) for event in said) == 3
        hear(discovery, 3 * S, *(RESPONSE for _ in self.PEERS), source=3)
        ours = [now for now in self.answers(discovery, 3 * S, m.SubscribeRequest) if now % (S // 2)]
        assert len(ours) == 1

    def test_who_has_answered_meanwhile_is_not_asked(self) -> None:
        discovery = self.beside_many()
        for n in self.PEERS:
            hear(discovery, 3 * S, m.Advertise("cmd", 12), source=n)
        for n in self.PEERS:
            hear(discovery, 3 * S, RESPONSE, source=n)
        due = run(discovery, 3 * S, 3 * S + 700 * MS)
        requests = [event for event in sent(event for _, event in due) if isinstance(event, m.SubscribeRequest)]
        assert len(requests) <= 1, "that is the repetition of our own"

    def test_who_leaves_is_not_answered(self) -> None:
        discovery = self.beside_many()
        for n in self.PEERS:
            hear(discovery, 3 * S, REQUEST, source=n)
        hear(discovery, 3 * S, m.Unsubscribe("leds", 29), source=29)
        hear(discovery, 3 * S, m.Hello("M28", 28, m.HELLO_LEAVING), source=28)
        joined = {event.source for _, event in run(discovery, 3 * S, 5 * S) if isinstance(event, SubscriberJoined)}
        assert joined == set(range(3, 28))
        for n in self.PEERS:
            hear(discovery, 5 * S, REQUEST, source=n)
        discovery.withdraw(5 * S, "leds")
        assert not [event for _, event in run(discovery, 5 * S, 7 * S) if isinstance(event, SubscriberJoined)]

    def test_firmware_is_answered_each_time_all_the_same(self) -> None:
        discovery = self.beside_many()
        for n in range(100, 130):
            assert len(sent(hear(discovery, 3 * S, REQUEST, m.Advertise("cmd", 12), source=n))) == 2


class TestTypes:
    def test_types_go_before_what_they_belong_to_but_only_to_r2p(self) -> None:
        discovery = started()
        hear(discovery, S, PC2)
        mine = [m.TypeInfo(m.ROLE_PUBLISHES, "leds", ONE, 5), m.TypeInfo(m.ROLE_SUBSCRIBES, "cmd", TWO, 12)]
        repeated = sent(discovery.poll(S))
        unanswered = m.SubscribeRequest("cmd", 12, 5, m.UNANSWERED)
        assert repeated[2:] == [mine[0], m.Advertise("leds", 5, 0, m.UNANSWERED), mine[1], unanswered]
        assert sent(hear(discovery, S, REQUEST)) == [mine[0], m.SubscribeResponse("leds", 5, 8)]
        assert sent(hear(discovery, S, REQUEST)) == [m.SubscribeResponse("leds", 5, 8)], "a repeat"
        assert sent(hear(discovery, S, m.Advertise("cmd", 12))) == [mine[1], unanswered]
        assert sent(hear(discovery, S, REQUEST, source=0x28)) == [m.SubscribeResponse("leds", 5, 8)]

    def test_a_subscriber_of_another_type_is_refused(self) -> None:
        discovery = started()
        theirs = m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", TWO, 5)
        told = Mismatched("leds", None, m.ROLE_SUBSCRIBES, TopicType(5, ONE), TopicType(5, TWO))
        hear(discovery, S, PC2)
        assert hear(discovery, S, theirs) == [told]
        answer = hear(discovery, S, REQUEST, theirs, REQUEST)
        assert sent(answer) == [m.TypeInfo(m.ROLE_PUBLISHES, "leds", ONE, 5)] * 2
        assert changes_in(answer) == []

    def test_a_publisher_of_another_type_is_refused(self) -> None:
        discovery = started()
        theirs = m.TypeInfo(m.ROLE_PUBLISHES, "cmd", ONE, 12)
        told = Mismatched("cmd", None, m.ROLE_PUBLISHES, TopicType(12, TWO), TopicType(12, ONE))
        hear(discovery, S, PC2)
        assert hear(discovery, S, theirs) == [told]
        answer = hear(discovery, S, m.Advertise("cmd", 12), RESPONSE)
        assert sent(answer) == [m.TypeInfo(m.ROLE_SUBSCRIBES, "cmd", TWO, 12)]
        assert changes_in(answer) == []

    def test_a_late_type_undoes_what_was_done(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, REQUEST, RESPONSE)
        wrong = [m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", TWO, 5), m.TypeInfo(m.ROLE_PUBLISHES, "cmd", ONE, 12)]
        events = hear(discovery, S, *wrong)
        assert [type(event) for event in events] == [Mismatched, SubscribersGone, Mismatched, PublisherGone]

    def test_a_type_that_was_corrected_fits(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", TWO, 5), REQUEST)
        assert hear(discovery, S, m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", ONE, 5)) == []
        assert joined(discovery, S)

    def test_our_own_correction_counts_too(self) -> None:
        discovery = started()
        right = m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", ONE, 5)
        hear(discovery, S, PC2, right, REQUEST)
        assert [type(event) for event in changes_in(discovery.advertise(S, "leds", 5, TWO))] == [
            Mismatched,
            SubscribersGone,
        ]
        assert changes_in(discovery.advertise(S, "leds", 5, ONE)) == []
        assert joined(discovery, S)

    @pytest.mark.parametrize("fingerprint", [m.ANY_TYPE, ONE])
    def test_any_type_fits_all(self, fingerprint: bytes) -> None:
        discovery = started()
        hear(discovery, S, PC2)
        size = 5 if fingerprint == ONE else 0
        assert changes_in(hear(discovery, S, m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", fingerprint, size))) == []
        assert joined(discovery, S)

    def test_a_changed_type_is_announced_again(self) -> None:
        discovery = started()
        hear(discovery, S, PC2, m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", TWO, 5))
        third = m.TypeInfo(m.ROLE_SUBSCRIBES, "leds", b"\x03" * 8, 9)
        assert [type(event) for event in hear(discovery, S, third, third)] == [Mismatched]

    def test_only_r2p_modules_get_unsubscribe(self) -> None:
        discovery = started()
        assert sent(discovery.unsubscribe(SOON, "cmd")) == []
        hear(discovery, SOON, PC2)
        discovery.poll(SOON)
        discovery.subscribe(SOON, "cmd", 12)
        assert sent(discovery.unsubscribe(SOON, "cmd")) == [m.Unsubscribe("cmd", ME)]
