"""Discovery in both roles of the recorded conversations: as the firmware's module, and as its peer."""

import pytest

from r2p.codecs import management as m
from r2p.codecs.debug import Reader
from r2p.protocols.discovery.events import (
    Command,
    CommandReceived,
    Event,
    PublisherFound,
    SubscriberJoined,
)
from r2p.protocols.discovery.session import Discovery
from tests.protocols.discovery.wire import MS, changes_in, sent
from tests.vectors import FROM_NODE, TO_NODE, Case, Entry, cases

PROMPT_MS = 4
"""Firmware answers within this time."""

PubSub = m.Advertise | m.SubscribeRequest | m.SubscribeResponse
PLAIN = [case for case in cases("pubsub") if "malformed" not in case.name]
NOT_LIKE_US = (
    "subscribe_leds_queue0-",  # queue_length 0 halts firmware: it has no answer to compare with
    "cmd_queue_nonzero_subres-bridge",  # a firmware gateway also answers for topics that it only subscribes
)
DEBUG_LINE = [case for case in cases() if case.group != "bootloader" and case.stream(TO_NODE) + case.stream(FROM_NODE)]


def management(entry: Entry) -> list[m.Management]:
    return [m.decode(line.data) for line in Reader().feed(entry.data) if line.topic == b"R2P"]


def gist(messages: list[m.Management]) -> list[tuple[str, str, int]]:
    """What an answer is about: its queue and raw_params mean nothing."""
    return [(type(each).__name__, each.topic, each.size) for each in messages if isinstance(each, PubSub)]


def recorded_answers(case: Case, at: int) -> list[tuple[str, str, int]]:
    """What the firmware said to the message at this place of the transcript: only of its topic, so no repetition."""
    asked = management(case.transcript[at])
    answer = {m.Advertise: m.SubscribeRequest, m.SubscribeRequest: m.SubscribeResponse}
    wanted = {(answer.get(type(each)), each.topic) for each in asked if isinstance(each, PubSub)}
    soon = case.transcript[at].t_ms + PROMPT_MS
    said = [
        each
        for entry in case.transcript[at + 1 :]
        if entry.dir == FROM_NODE and entry.t_ms <= soon
        for each in management(entry)
    ]
    return gist([each for each in said if isinstance(each, PubSub) and (type(each), each.topic) in wanted])


@pytest.mark.golden
@pytest.mark.parametrize("case", [case for case in PLAIN if not str(case).startswith(NOT_LIKE_US)], ids=str)
def test_as_the_module_it_answers_like_firmware(case: Case) -> None:
    """The topics exist from the first ADVERTISE on, and end with what ends the module."""
    node = Discovery("IMU1" if case.build.startswith("plain") else "IMUGW", 1)
    node.link_up(0)
    ends: list[Event] = []
    for at, entry in enumerate(case.transcript):
        now = entry.t_ms * MS
        for message in management(entry):
            if entry.dir == FROM_NODE and isinstance(message, m.Advertise):
                node.advertise(now, "leds", 5)
                node.subscribe(now, "cmd", 12, 5)
            elif entry.dir == TO_NODE:
                events = node.receive(now, m.encode(message) if not _queueless(message) else _raw(entry))
                assert gist(sent(events)) == recorded_answers(case, at), f"at {entry.t_ms} ms"
                obeyed = [event for event in changes_in(events) if isinstance(event, CommandReceived)]
                if obeyed:
                    node.withdraw(now, "leds")
                    node.unsubscribe(now, "cmd")
                ends += obeyed
    assert ends == {
        "stop_own": [CommandReceived(Command.STOP)],
        "reboot_own": [CommandReceived(Command.REBOOT)],
        "bootload_own": [CommandReceived(Command.BOOTLOAD), CommandReceived(Command.REBOOT)],
    }.get(case.name, [])


def _queueless(message: m.Management) -> bool:
    return isinstance(message, m.SubscribeRequest) and not message.queue


def _raw(entry: Entry) -> bytes:
    return Reader().feed(entry.data)[0].data


@pytest.mark.golden
@pytest.mark.parametrize("case", DEBUG_LINE, ids=str)
def test_as_the_peer_it_opens_what_flows(case: Case) -> None:
    """Whatever the recorded peer asked or offered, ours does too, from the same moment on."""
    peer = Discovery("PC1", 1)
    peer.link_up(0)
    happened: list[Event] = []
    for entry in case.transcript:
        now = entry.t_ms * MS
        for message in management(entry):
            if entry.dir == FROM_NODE:
                happened += peer.receive(now, m.encode(message))
            elif isinstance(message, m.SubscribeRequest):
                happened += peer.subscribe(now, message.topic, 0, message.queue)
            elif isinstance(message, m.Advertise | m.SubscribeResponse):
                happened += peer.advertise(now, message.topic, message.size)
    heard = {each.decoded.get("topic") for each in case.transcript if each.dir == FROM_NODE} - {None, "R2P"}
    opened = {event.topic for event in happened if isinstance(event, PublisherFound)}
    assert heard <= opened
    joined = [event.topic for event in happened if isinstance(event, SubscriberJoined)]
    assert len(joined) == len(set(joined)) or "reboot" in case.name or "bootload" in case.name
    names = {
        message.module for entry in case.transcript for message in management(entry) if isinstance(message, m.Alive)
    }
    assert set(peer.modules) == names


@pytest.mark.golden
@pytest.mark.parametrize("name", ["gw_auto_leds", "gw_auto_cmd"])
def test_as_the_peer_it_answers_like_the_old_tools(name: str) -> None:
    """Those answered every ADVERTISE, or every SUBSCRIBE_REQUEST, of one topic."""
    (case,) = cases(name=name)
    peer = Discovery("PC1", 1)
    peer.link_up(0)
    if name == "gw_auto_leds":
        peer.subscribe(0, "leds", 5, 5)
    else:
        peer.advertise(0, "cmd", 12)
    ours = [
        each
        for entry in case.transcript
        if entry.dir == FROM_NODE
        for message in management(entry)
        for each in gist(sent(peer.receive(entry.t_ms * MS, m.encode(message))))
    ]
    theirs = [each for entry in case.transcript if entry.dir == TO_NODE for each in gist(management(entry))]
    assert ours == theirs
    assert ours
