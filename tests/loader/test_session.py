"""The PC's side of a session: what was recorded, lost messages, and whatever else may arrive."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import loader as codec
from r2p.codecs.debug import Reader
from r2p.loader import procedures
from r2p.loader.procedures import AppListing
from r2p.loader.session import LoaderRefused, LoaderSession, LoaderSilent, LoaderStep, Procedure
from r2p.sim.modules import EmulatedLoader, LoaderFaults
from tests.vectors import FROM_NODE, TO_NODE, Case, cases, loader_cases

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

SECOND = 1_000_000_000
SESSIONS = loader_cases() + cases("bootloader")
BEGINS = (codec.BeginLoader, codec.BeginAppinfo, codec.BeginGetparam, codec.BeginSetparam)
CONFIG = bytes(range(24))

Message = tuple[str, codec.Loader]


def recorded(case: Case, size: int) -> Iterator[Message]:
    """The loader's messages, of a line that arrived in chunks of `size` bytes."""
    for way, reader in ((entry, Reader()) for entry in case.transcript):
        for start in range(0, len(way.data), size):
            for line in reader.feed(way.data[start : start + size]):
                if line.topic.startswith(b"BOOT_") and len(line.data) == codec.SIZE and line.data[30] <= 18:
                    yield way.dir, codec.decode(line.data)


def operations(messages: list[Message]) -> list[list[Message]]:
    """Parts that each begin with what opens a session."""
    parts: list[list[Message]] = [[]]
    for way, message in messages:
        if way == TO_NODE and isinstance(message, BEGINS):
            parts.append([])
        parts[-1].append((way, message))
    return [part for part in parts if part]


def as_procedure(part: list[Message]) -> Procedure[Any]:
    """The procedure that a peer carried out; one that just says the same, if it was none."""
    sent = [message for way, message in part if way == TO_NODE]
    if any(isinstance(message, codec.Nack) for _, message in part):
        return say(part)
    match sent:
        case [codec.BeginAppinfo(), *acks, codec.Ack()] if all(isinstance(each, codec.Ack) for each in acks):
            return procedures.list_apps()
        case [codec.BeginGetparam(), codec.ParamRequest() as asked, *_, codec.Ack(), codec.EndGetparam()]:
            return procedures.get(asked.appname, asked.offset, asked.length)
        case [codec.BeginSetparam(), codec.ParamRequest() as asked, *chunks, codec.EndSetparam()]:
            data = b"".join(each.data for each in chunks if isinstance(each, codec.ParamChunk))
            return procedures.set_(asked.appname, asked.offset, data[: asked.length])
        case [codec.BeginLoader(), codec.RemoveLast(), codec.EndLoader()]:
            return procedures.remove_last()
        case [codec.BeginLoader(), codec.RemoveAll(), codec.EndLoader()]:
            return procedures.remove_all()
        case [codec.BeginLoader(), codec.LinkingSetup() as setup, codec.LinkingOutcome() as outcome, *rest]:
            records = [each for each in rest if isinstance(each, codec.IhexRecord)]
            if len(rest) == len(records) + 1 and isinstance(rest[-1], codec.EndLoader) and records[-1].kind == 1:
                return procedures.load(setup, lambda _: (outcome, records))
    return say(part)


def say(part: list[Message]) -> Procedure[None]:
    """Send what was sent, and take what was answered."""
    answers = 0
    for way, message in part:
        if way == TO_NODE:
            answers += sum(1 for _ in [(yield LoaderStep(message, pause=0.001))])


def replay(case: Case, size: int = 1000) -> list[Any]:
    """The session in the recorded peer's place; returns the results."""
    session, now, results = LoaderSession(), 0, []
    for part in operations(list(recorded(case, size))):
        procedure = as_procedure(part)
        is_real = inspect.getgeneratorlocals(procedure).keys() != {"part"}  # of `say`
        session.start(procedure, now)
        sent: list[bytes] = []
        for way, message in part:
            if way == FROM_NODE:
                session.receive(codec.encode(message), now)
                continue
            while not (sent := sent or session.outgoing()):
                assert session.running
                now = session.next_deadline() or now
                session.poll(now)
            assert codec.decode(sent.pop(0)) == message
        while (deadline := session.next_deadline()) is not None and not is_real:
            session.poll(now := deadline)
        assert not session.running
        assert not session.outgoing()
        assert not (is_real and session.dropped)
        session.dropped.clear()
        results.append(session.error or session.result)
    return results


@pytest.mark.golden
@pytest.mark.parametrize("case", SESSIONS, ids=str)
def test_it_says_what_the_recorded_peer_said(case: Case) -> None:
    replay(case)


@pytest.mark.golden
@pytest.mark.parametrize("size", range(1, 90))
def test_answers_arrive_in_chunks_of_every_size(size: int) -> None:
    case = SESSIONS[size % len(SESSIONS)]
    assert str(replay(case, size)) == str(replay(case))


@pytest.mark.golden
def test_results_are_what_was_recorded() -> None:
    (case,) = [each for each in SESSIONS if each.name == "whole_session"]
    results = replay(case)
    listings = [each for each in results if isinstance(each, AppListing)]
    assert [[app.name for app in each.apps] for each in listings] == [["APP1"], ["APP1", "ABCDEFGH"], ["APP1"]]
    assert listings[0].summary.freeadr == 0x0800F490
    assert listings[0].apps[0].ram == [range(0x20004FF0, 0x20005000), range(0x20004FE8, 0x20004FF0)]
    assert results[3].hex() == "df6af1d8303e61cdc4bb86c3d1c42710"
    assert b"hello" in results


# Against the emulated loader


class Pair:
    """A session and an emulated loader, without anything in between."""

    def __init__(self, faults: LoaderFaults | None = None) -> None:
        self.loader = EmulatedLoader(faults=faults)
        self.session = LoaderSession()
        self.now = 0
        self.loader.boot(0)

    def run(self, procedure: Procedure[Any]) -> Any:
        """Run a procedure to its end. Raises its error."""
        self.session.start(procedure, self.now)
        while self.session.running:
            for data in self.session.outgoing():
                self.loader.receive(self.now, data)
            deadlines = [self.session.next_deadline(), self.loader.next_deadline()]
            self.now = max(self.now, min(each for each in deadlines if each is not None))
            for answer in self.loader.poll(self.now):
                self.session.receive(answer, self.now)
            self.session.poll(self.now)
        if self.session.error is not None:
            raise self.session.error
        return self.session.result

    def names(self) -> list[str]:
        """The installed apps."""
        return [each.name for each in self.run(procedures.list_apps()).apps]


def load(name: str = "blink") -> Procedure[Any]:
    return procedures.load(codec.LinkingSetup(pgmlen=32, bsslen=8, datalen=0, stacklen=1024, name=name), link)


def link(addresses: codec.LinkingAddresses) -> tuple[codec.LinkingOutcome, list[codec.IhexRecord]]:
    begin = addresses.pgmadr
    outcome = codec.LinkingOutcome(begin + 25, begin, len(CONFIG), 0, 0, 0, 0)
    image = CONFIG.ljust(32, b"\xbf")
    base = record(4, 0, (begin >> 16).to_bytes(2, "big"))
    data = [record(0, (begin & 0xFFFF) + at, image[at : at + 16]) for at in (0, 16)]
    return outcome, [base, *data, record(1, 0, b"")]


def record(kind: int, offset: int, data: bytes) -> codec.IhexRecord:
    total = len(data) + (offset >> 8) + (offset & 0xFF) + kind + sum(data)
    return codec.IhexRecord(len(data), offset, kind, data.ljust(16, b"\0"), -total & 0xFF)


def test_apps_are_loaded_read_set_and_removed() -> None:
    pair = Pair()
    pair.run(load("one"))
    pair.run(load("two"))
    assert pair.names() == ["one", "two"]
    assert pair.run(procedures.get("two", 3, 20)) == CONFIG[3:23]
    pair.run(procedures.set_("two", 1, bytes(20)))
    assert pair.run(procedures.get("two", 0, 24)) == b"\0" * 21 + CONFIG[21:]
    pair.run(procedures.remove_last())
    assert pair.names() == ["one"]
    pair.run(procedures.remove_all())
    assert pair.names() == []
    assert not pair.session.dropped
    assert not pair.session.repeated


LAST = 9  # messages of `load`: BEGIN, setup, outcome, base, two records, end of file and END
IDEMPOTENT = {1, 4, 5, 6}  # BEGIN, the base and the records


@pytest.mark.parametrize("kind", ["lost_requests", "lost_answers"])
@pytest.mark.parametrize("number", range(1, LAST))
def test_only_what_may_come_twice_is_repeated(kind: str, number: int) -> None:
    faults = LoaderFaults()
    getattr(faults, kind).add(number)
    pair = Pair(faults)
    if number in IDEMPOTENT:
        pair.run(load())
        assert pair.session.repeated
    else:
        with pytest.raises(LoaderSilent, match="did not answer"):
            pair.run(load())
        assert not pair.session.repeated
        pair.run(procedures.go_idle())
    faults.lost_requests.clear()
    faults.lost_answers.clear()
    if "blink" not in pair.names():
        pair.run(load())
    assert pair.names() == ["blink"]
    assert pair.run(procedures.get("blink", 0, 24)) == CONFIG


@pytest.mark.parametrize("number", range(1, LAST))
def test_a_refusal_ends_the_session_and_the_next_one_begins_anew(number: int) -> None:
    pair = Pair(LoaderFaults(refused={number}))
    if number == 1:
        pair.run(load())  # BEGIN was refused as in the middle of something else, and came again
    else:
        with pytest.raises(LoaderRefused, match="NACK, line"):
            pair.run(load())
    assert pair.names() in ([], ["blink"])
    pair.run(load("other"))
    assert pair.names()[-1] == "other"


def test_a_late_answer_is_not_taken_for_the_next_one() -> None:
    session = LoaderSession()
    session.start(procedures.remove_last(), 0)
    session.receive(codec.encode(codec.Ack()), 0)
    session.poll(SECOND)
    assert isinstance(session.error, LoaderSilent)
    session.start(procedures.list_apps(), SECOND)
    assert session.outgoing()[2:] == []  # BEGIN and REMOVE_LAST, of before: nothing of the listing yet
    session.receive(codec.encode(codec.Ack()), SECOND)
    assert session.outgoing() == [codec.encode(codec.BeginAppinfo())]
    assert session.dropped == {"too late": 1}


def test_all_answers_to_a_repeated_message_are_awaited_and_the_last_one_counts() -> None:
    session = LoaderSession()
    session.start(procedures.remove_last(), 0)
    session.poll(SECOND)
    assert session.outgoing() == [codec.encode(codec.BeginLoader())] * 2
    session.receive(codec.encode(codec.Ack()), SECOND)
    assert session.outgoing() == []
    session.receive(codec.encode(codec.Nack(line=131)), SECOND)  # to the second one: the session is over
    assert session.outgoing() == [codec.encode(codec.BeginLoader())]


MESSAGES = st.one_of(
    st.binary(max_size=40),
    st.binary(min_size=30, max_size=30).flatmap(lambda body: st.integers(0, 20).map(lambda kind: body + bytes([kind]))),
)
PROCEDURES: list[Callable[[], Procedure[Any]]] = [
    load,
    procedures.list_apps,
    procedures.remove_all,
    procedures.go_idle,
    lambda: procedures.get("blink", 0, 100),
    lambda: procedures.set_("blink", 0, bytes(300)),
]


@given(st.sampled_from(PROCEDURES), st.lists(MESSAGES, max_size=60), st.data())
def test_whatever_arrives_a_procedure_comes_to_its_end(
    procedure: Callable[[], Procedure[Any]], arrives: list[bytes], data: st.DataObject
) -> None:
    session, now = LoaderSession(), 0
    session.start(procedure(), now)
    for each in arrives:
        session.receive(each, now)
        if data.draw(st.booleans()):
            session.poll(now := session.next_deadline() or now)
    for _ in range(500):
        session.poll(now := session.next_deadline() or now)
    assert not session.running
