"""r2p's own services: what each module can be asked for by others, without a topic or an announcement of its own.

    fetch  ->  _ask, page by page  ->  CallChannel of the nearest link  ...  receive  ->  _answer  ->  a handler
    the answer                                                         ...  receive  ->  the waiting `_ask`

Messages are those of `r2p.codecs.own_services`. A request is addressed to the instance of a module, and gateways pass
it on (`r2p.bridge.calls`). It is repeated until it is answered; a repeated one gets the same answer again. A content
that does not fit a message is kept until its caller has fetched all pages of it.
"""

import asyncio
from collections.abc import Callable, Hashable, Iterator
from typing import TYPE_CHECKING

import msgspec

from r2p.codecs import UnknownType, own_services, services
from r2p.codecs.own_services import EDITIONS, PAGE_MAX, PAGES_MAX, WIRE_MIN, Operation, OwnCall
from r2p.codecs.services import NUMBERS, Kind, ServiceHeader
from r2p.errors import DecodeError, ServiceError
from r2p.protocols.discovery.events import ModuleInfo
from r2p.runtime.topic import TopicSpace
from r2p.services.answers import RememberedAnswers
from r2p.transports.link import Link
from r2p.units import SECOND

if TYPE_CHECKING:
    from r2p.bridge.calls import CallRelay

Handler = Callable[[bytes], bytes]
"""Returns the content for an argument; raises LookupError or ValueError with a text for the caller."""

_PATIENCE = 1.5  # seconds that a module on the link itself may be silent
_PATIENCE_BEHIND = 3.0  # ... and one behind gateways, whose other links may be slow
_SLOW = 4  # times that a message takes on a slow link, for which it may be silent besides
_FIRST_PAUSE = 0.1  # seconds until a request is repeated
_GROWTH = 1.5  # of the pause, each time
_SHORTEST_PAUSE = 0.001  # seconds
_TRIES = 3  # times that a content is fetched from its beginning, if its module forgets it meanwhile
_REMEMBERED = 10 * SECOND  # ns for which an answer is remembered
_CONTENTS_MAX = 64  # contents of several pages that are kept: the latest of each caller and argument


class _Question(msgspec.Struct, eq=False):
    """A request that waits for its answer."""

    header: ServiceHeader
    operation: int
    page: int
    answer: "asyncio.Future[OwnCall]"

    def is_answered_by(self, call: OwnCall) -> bool:
        same = (call.header.number, call.header.server) == (self.header.number, self.header.server)
        return same and (call.operation, call.page) == (self.operation, self.page)


class _Content(msgspec.Struct, frozen=True):
    """A content of several pages, as a caller began to fetch it."""

    edition: int
    data: bytes

    @property
    def pages(self) -> int:
        return max(1, -(-len(self.data) // PAGE_MAX))

    def page(self, number: int) -> bytes:
        return self.data[number * PAGE_MAX : (number + 1) * PAGE_MAX]


class OwnServices:
    """The own services of one module, as caller and as server; `relay` passes on what is for others, in a gateway."""

    def __init__(self, space: TopicSpace, instance: int, links: list[Link]) -> None:
        self.relay: CallRelay | None = None
        self._space = space
        self._clock = space.clock
        self._instance = instance
        self._links = links
        self._number = instance % NUMBERS  # another one after each start
        self._questions: dict[int, _Question] = {}
        self._handlers: dict[int, Handler] = {}
        self._answers = RememberedAnswers()
        self._contents: dict[tuple[int, int, bytes], _Content] = {}
        self._edition = 0

    def serve(self, operation: Operation, handler: Handler) -> None:
        """Answer requests for this operation with what `handler` returns."""
        self._handlers[operation] = handler

    # As caller

    async def fetch(self, instance: int, operation: Operation, argument: bytes = b"") -> bytes:
        """Return the content that a module gives for an argument, all pages of it.

        Raises TimeoutError if the module is silent, and ServiceError with the text of its error.
        """
        if instance == self._instance:
            return self._handlers[operation](argument)
        for _ in range(_TRIES):
            content = await self._fetch_edition(instance, operation, argument)
            if content is not None:
                return content
        raise ServiceError("the module forgets what it was asked for faster than that can be fetched: try again")

    async def _fetch_edition(self, instance: int, operation: Operation, argument: bytes) -> bytes | None:
        """Return the content; None if the module has forgotten it meanwhile."""
        first = await self._ask(instance, operation, argument)
        if first.header.kind is not Kind.RESPONSE:
            raise ServiceError(services.decode_text(first.body) or "the module answers with an error")
        if first.pages > PAGES_MAX:
            raise ServiceError(f"an answer of {first.pages} pages, more than {PAGES_MAX}")
        pages = [first.body]
        for page in range(1, first.pages):
            call = await self._ask(instance, operation, argument, page, first.edition)
            if call.header.kind is not Kind.RESPONSE or call.edition != first.edition:
                return None
            pages.append(call.body)
        return b"".join(pages)

    async def _ask(
        self, instance: int, operation: Operation, argument: bytes, page: int = 0, edition: int = 0
    ) -> OwnCall:
        """Send a request, again and again, until it is answered. Raises TimeoutError."""
        header = ServiceHeader(self._instance, self._next_number(), Kind.REQUEST, instance)
        question = _Question(header, operation, page, self._space.loop.create_future())
        request = own_services.encode(OwnCall(header, operation, page, 0, edition, argument))
        self._questions[header.number] = question
        try:
            await self._repeat(request, question)
        finally:
            del self._questions[header.number]
        return question.answer.result()

    async def _repeat(self, request: bytes, question: _Question) -> None:
        start, pause, patience = self._space.loop.time(), _FIRST_PAUSE, _PATIENCE
        while not question.answer.done():
            nearest = self._nearest(question.header.server)
            if nearest is not None:
                link, info = nearest
                slow = link.calls.duration
                patience = (_PATIENCE_BEHIND if info.hops else _PATIENCE) + _SLOW * slow
                pause = max(pause, 2 * slow)
            left = start + patience - self._space.loop.time()
            if left < _SHORTEST_PAUSE:
                raise TimeoutError("no answer")
            if nearest is not None:
                link.calls.send(request, info.source)
            await asyncio.wait([question.answer], timeout=min(pause, left))
            pause *= _GROWTH

    def _nearest(self, instance: int) -> tuple[Link, ModuleInfo] | None:
        """Return the link by which a module is reached now, and the module as it is known there."""
        found = [(link, info) for link in self._links if link.up for info in _with_instance(link, instance)]
        return min(found, key=lambda each: each[1].hops, default=None)

    def _next_number(self) -> int:
        """Return a number that no call has that waits."""
        while True:
            self._number = (self._number + 1) % NUMBERS
            if self._number not in self._questions:
                return self._number

    # As server, and in between

    def receive(self, link: Link, data: bytes, source: Hashable) -> None:
        """Handle a message that came by a link."""
        try:
            call = own_services.decode(data)
        except UnknownType:
            link.stats.lost["unknown type"] += 1
        except DecodeError:
            link.stats.lost["undecodable"] += 1
        else:
            self._handle(link, call, data, source)

    def _handle(self, link: Link, call: OwnCall, data: bytes, source: Hashable) -> None:
        if call.target != self._instance:
            if self.relay is not None:
                self.relay.forward(link, call, data)
        elif call.header.kind is Kind.REQUEST:
            if link.calls.full:  # do not even make the answer
                link.stats.lost["calls, send buffer full"] += 1
            else:
                link.calls.send(self._answer(link, call), source)
        elif not call.is_request:
            question = self._questions.get(call.header.number)
            if question is not None and question.is_answered_by(call) and not question.answer.done():
                question.answer.set_result(call)

    def _answer(self, link: Link, call: OwnCall) -> bytes:
        """Return the answer to a request, the same for each repetition of it."""
        caller, number, now = call.header.instance, call.header.number, self._clock.monotonic()
        known = self._answers.get(caller, number, now, _REMEMBERED)
        if known is None:
            known = self._make_answer(link, call)
            self._answers.put(caller, number, known, now, _REMEMBERED)
        return known

    def _make_answer(self, link: Link, call: OwnCall) -> bytes:
        try:
            content = self._content(call)
        except (LookupError, ValueError) as error:
            text = str(error.args[0] if error.args else type(error).__name__)
            return self._reply(call, Kind.ERROR, services.encode_text(text, PAGE_MAX))
        except Exception as error:  # noqa: BLE001 - counted and logged; the caller learns of it
            link.stats.lost.internal_error(error)
            return self._reply(call, Kind.ERROR, b"internal error: the log of the module has it")
        if call.page >= content.pages:
            return self._reply(call, Kind.ERROR, b"no such page")
        return self._reply(call, Kind.RESPONSE, content.page(call.page), content)

    def _content(self, call: OwnCall) -> _Content:
        """Return what a caller asks for: what it began to fetch, or something new for a first page."""
        key = (call.header.instance, call.operation, call.body)
        if call.page:
            kept = self._contents.get(key)
            if kept is None or kept.edition != call.edition:
                raise LookupError("this edition is forgotten: begin with the first page")
            return kept
        handler = self._handlers.get(call.operation)
        if handler is None:
            raise LookupError(f"operation {call.operation} is unknown to this version of r2p")
        self._edition = self._edition % (EDITIONS - 1) + 1
        content = _Content(self._edition, handler(call.body))
        if content.pages > PAGES_MAX:
            raise ValueError(f"{len(content.data)} bytes, more than {PAGES_MAX * PAGE_MAX}")
        self._contents.pop(key, None)
        if content.pages > 1:
            self._contents[key] = content
            if len(self._contents) > _CONTENTS_MAX:
                del self._contents[next(iter(self._contents))]
        return content

    def _reply(self, call: OwnCall, kind: Kind, body: bytes, content: _Content | None = None) -> bytes:
        header = ServiceHeader(call.header.instance, call.header.number, kind, self._instance)
        pages, edition = (0, 0) if content is None else (content.pages, content.edition)
        return own_services.encode(OwnCall(header, call.operation, call.page, pages, edition, body))


def may_answer(link: Link, info: ModuleInfo) -> bool:
    """Return whether a module knows own services, and gateways on the link, if it is behind any, pass them on."""
    if not info.r2p or info.wire < WIRE_MIN:
        return False
    gateways = [each.wire for each in link.discovery.modules.values() if each.gateway] if info.hops else []
    return not gateways or max(gateways) >= WIRE_MIN


def _with_instance(link: Link, instance: int) -> Iterator[ModuleInfo]:
    return (info for info in link.discovery.modules.values() if info.instance == instance)
