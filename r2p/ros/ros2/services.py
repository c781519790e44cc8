"""Servers and clients of ROS 2 services over zenoh.

A request is a query, a response its reply, with the request's number and gid. A client repeats a request that nothing
answered, which may arrive all the same: a server answers the repetition as it answered the first one, and does not act
again.
"""

import asyncio
import contextlib
import math
from collections import OrderedDict
from typing import TYPE_CHECKING

import zenoh
from zenoh.handlers import Callback

from r2p.errors import DecodeError, NoServer, ServiceError
from r2p.messages import SIZE_MAX
from r2p.ros.middleware import Qos, RosServer, RosService
from r2p.ros.ros2.graph import explain_mismatch
from r2p.ros.ros2.keys import (
    ATTACHMENT_MAX,
    GID_BYTES,
    EntityKind,
    data_key,
    decode_attachment,
    encode_attachment,
    encode_token,
    gid_of,
)
from r2p.ros.ros2.session import RmwSession
from r2p.ros.type_names import dds_type

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

_REMEMBERED_MAX = 256  # requests of a service whose answers are kept for repetitions
_REPETITIONS_MAX = 16  # of a request that waits; of more, the oldest are dropped
_REPLIES_MAX = 1024  # that wait for a caller which does not read; until then further requests are lost
_KEPT_BYTES_MAX = 4096  # bytes of such an answer; a request with a longer one is served again
_ERROR_MAX = 4096  # bytes of an error's text
_PAUSES = (0.1, 0.5, 2.0)  # seconds until a request is repeated that nothing answered, though there is a server
_LONGEST_S = 86_400.0  # seconds that zenoh keeps a query without a time-out

_QOS = Qos()
"""Of all services: reliable, volatile, 10."""


class RmwRequest:
    """A request, with its repetitions; answered once, either way."""

    def __init__(self, session: RmwSession, key: str, sequence: int, gid: bytes) -> None:
        self.queries: list[zenoh.Query] = []
        self.done = False
        self.kept: bytes | str | None = None
        """The answer for repetitions, if it is short: a response, or an error's text."""
        self.cancel: Callable[[], object] = lambda: None
        """Ends the handling: the caller is gone."""
        self.gid = gid
        self._session = session
        self._key = key
        self._sequence = sequence

    def answer(self, response: bytes) -> None:
        """Send the response."""
        self._finish(response)

    def refuse(self, text: str) -> None:
        """Send the text of an error. ROS 2 has none: its clients log it, and go on waiting."""
        self._finish(text)

    def _finish(self, answer: bytes | str) -> None:
        if self.done:
            return
        self.done = True
        self.kept = answer if len(answer) <= _KEPT_BYTES_MAX else None
        queries, self.queries = self.queries, []
        for query in queries:
            self.reply(query, answer)

    def reply(self, query: zenoh.Query, answer: bytes | str) -> None:
        """Reply to one of the queries of this request."""
        session = self._session
        gid = self.gid[:GID_BYTES].ljust(GID_BYTES, b"\0")
        header = encode_attachment(self._sequence, session.clock.now(), gid)

        def send() -> None:  # with the priority of the query
            with contextlib.suppress(zenoh.ZError):  # the session is closed
                if isinstance(answer, str):
                    query.reply_err(answer)
                else:
                    query.reply(self._key, bytes(answer), attachment=header)
                query.drop()

        session.requests.submit(send)


class RmwServer:
    """A server of one of the link's ROS nodes."""

    def __init__(self, session: RmwSession, server: RosServer) -> None:
        self.server = server
        self._session = session
        self._requests: OrderedDict[Hashable, RmwRequest] = OrderedDict()
        dds_name = dds_type(server.type.name, service=True)
        self._key = data_key(session.domain, server.service, dds_name, server.type.checksum)
        handler = Callback(session.queue(self._on_query).put, indirect=False)
        remote = zenoh.Locality.REMOTE
        self._queryable = session.zenoh.raw.declare_queryable(self._key, handler, complete=True, allowed_origin=remote)
        self.token = session.declare(
            EntityKind.SERVER, server.node, server.service, dds_name, server.type.checksum, _QOS
        )

    def close(self) -> None:
        """Undeclare the server, and refuse requests that wait."""
        self._session.undeclare(self.token)
        self._queryable.undeclare()
        for request in self._requests.values():
            request.refuse(f"the server of {self.server.service} ended")
        self._requests.clear()

    def cancel(self, gid: bytes) -> None:
        """Cancel the requests of a client that is gone."""
        for request in list(self._requests.values()):
            if request.gid == gid and not request.done:
                request.done = True
                request.queries.clear()
                self._session.lost.guard(request.cancel)

    def _on_query(self, query: zenoh.Query) -> None:
        if self._session.requests.pending_calls >= _REPLIES_MAX:
            self._session.lost["too many calls"] += 1
            return
        payload, header = query.payload, query.attachment
        try:
            if payload is None or not 0 < len(payload) <= SIZE_MAX:
                raise DecodeError("a request without a payload, or with one that is too long")
            if header is None or len(header) > ATTACHMENT_MAX:
                raise DecodeError("a request needs an attachment: sequence number, time and gid")
            sequence, _, gid = decode_attachment(header.to_bytes())
        except DecodeError as error:
            self._session.lost["wrong request"] += 1
            RmwRequest(self._session, self._key, 0, b"").reply(query, str(error))
            return
        self._handle(query, sequence, gid, payload.to_bytes())

    def _handle(self, query: zenoh.Query, sequence: int, gid: bytes, data: bytes) -> None:
        # A gid that is no gid does not tell clients apart; the data does where a client counts from 1 once more.
        identity: Hashable = (gid, sequence, hash(data)) if len(gid) == GID_BYTES else object()
        request = self._requests.get(identity)
        if request is not None and request.kept is not None:
            request.reply(query, request.kept)
            return
        if request is not None and not request.done:
            request.queries.append(query)
            if len(request.queries) > _REPETITIONS_MAX:
                self._session.lost["too many calls"] += 1
                del request.queries[0]
            return
        request = self._requests[identity] = RmwRequest(self._session, self._key, sequence, gid)
        request.queries.append(query)
        self._forget_old()
        service = self.server.service
        caller = self._session.graph.node_of(gid, EntityKind.CLIENT, service)
        cancel = self._session.user.requested(service, caller, data, request.answer, request.refuse)
        if not request.done:
            request.cancel = cancel

    def _forget_old(self) -> None:
        """Forget the oldest answered requests; those that wait stay."""
        while len(self._requests) > _REMEMBERED_MAX:
            identity, request = next(iter(self._requests.items()))
            del self._requests[identity]
            if not request.done:
                self._requests[identity] = request
                return


class RmwClient:
    """The client of a service for one of the link's ROS nodes."""

    def __init__(self, session: RmwSession, node: str, service: str, type: RosService) -> None:
        self._session = session
        self._service = service
        self._type = dds_type(type.name, service=True)
        self._key = data_key(session.domain, service, self._type, type.checksum)
        self.token = session.declare(EntityKind.CLIENT, node, service, self._type, type.checksum, _QOS)
        self._gid = gid_of(encode_token(self.token))
        self._sequence = 0
        self._open: set[asyncio.Future[bytes | None]] = set()
        self._calls = 0

    @property
    def is_idle(self) -> bool:
        """Return whether no call waits."""
        return not self._calls

    def close(self) -> None:
        """Undeclare the client; calls that wait end with an error."""
        self._session.undeclare(self.token)
        for each in self._open:
            if not each.done():
                each.set_exception(ServiceError(f"the call of {self._service} ended: its ROS node is closed"))

    async def call(self, request: bytes, timeout: float) -> bytes:
        """Return the response. Raises NoServer, ServiceError or TimeoutError."""
        self._sequence += 1
        self._calls += 1
        try:
            async with asyncio.timeout(None if math.isinf(timeout) else timeout):
                response = await self._ask(request, self._sequence, timeout)
        finally:
            self._calls -= 1
        if response is None:
            raise NoServer(self._why_none())
        return response

    async def _ask(self, request: bytes, sequence: int, timeout: float) -> bytes | None:
        """Send the request until a server answers; return None if none does."""
        for pause in (*_PAUSES, None):
            response = await self._query(request, sequence, timeout)
            if response is not None or pause is None or not self._has_server():
                return response
            await asyncio.sleep(pause)  # its queryable is not known here yet
        return None

    def _has_server(self) -> bool:
        servers = self._session.graph.endpoints(EntityKind.SERVER, self._service)
        return any(each.key == self.token.key for each in servers)

    def _why_none(self) -> str:
        for server in self._session.graph.endpoints(EntityKind.SERVER, self._service):
            return explain_mismatch(self.token, server) or f"the server of {self._service} in {server.node} is silent"
        return f"no ROS node serves {self._service}"

    async def _query(self, request: bytes, sequence: int, timeout: float) -> bytes | None:
        """Return the response; None if the query ended without one."""
        session = self._session
        done: asyncio.Future[bytes | None] = session.loop.create_future()
        queue = session.queue(lambda reply: self._on_reply(reply, sequence, done))
        ends = zenoh.CancellationToken()
        attachment = encode_attachment(sequence, session.clock.now(), self._gid)

        def send() -> None:
            try:
                session.zenoh.raw.get(
                    self._key,
                    Callback(queue.put, lambda: queue.put(None), indirect=False),
                    target=zenoh.QueryTarget.ALL_COMPLETE,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    payload=bytes(request),
                    attachment=attachment,
                    timeout=min(timeout + 1.0, _LONGEST_S),
                    congestion_control=zenoh.CongestionControl.BLOCK,  # as in rmw_zenoh: routers drop no request then
                    express=True,
                    allowed_destination=zenoh.Locality.REMOTE,
                    cancellation_token=ends,
                )
            except zenoh.ZError:  # the session is closed
                queue.put(None)

        session.requests.submit(send)
        self._open.add(done)
        try:
            return await done
        finally:
            self._open.discard(done)
            if done.cancelled():
                session.requests.submit(ends.cancel)

    def _on_reply(self, reply: zenoh.Reply | None, sequence: int, done: "asyncio.Future[bytes | None]") -> None:
        """Handle a reply; None ends the query."""
        if done.done():
            return
        if reply is None:
            done.set_result(None)
        elif reply.ok is None:
            done.set_exception(ServiceError(_error_text(reply)))
        elif len(reply.ok.payload) > SIZE_MAX:
            done.set_exception(ServiceError(f"the response has {len(reply.ok.payload)} bytes, more than {SIZE_MAX}"))
        elif self._is_ours(reply.ok.attachment, sequence):
            done.set_result(reply.ok.payload.to_bytes())
        else:
            self._session.lost["wrong response"] += 1

    def _is_ours(self, header: zenoh.ZBytes | None, sequence: int) -> bool:
        """Return whether a response has the number and the gid of the request, or no attachment to compare."""
        if header is None:
            return True
        try:
            number, _, gid = decode_attachment(header.to_bytes() if len(header) <= ATTACHMENT_MAX else b"")
        except DecodeError:
            return False
        return number == sequence and gid == self._gid


def _error_text(reply: zenoh.Reply) -> str:
    payload = None if reply.err is None else reply.err.payload
    text = "" if payload is None or len(payload) > _ERROR_MAX else payload.to_bytes().decode(errors="replace")
    return text or "the server sent an error without a text"
