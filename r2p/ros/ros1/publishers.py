"""Publications: the topics that a node publishes, with a connection and a queue for each remote subscriber.

    Ros1Publication.publish  ->  SubscriberConnection.send  ->  socket      while it accepts, else `depth` messages wait

A socket that accepts no more is left alone until it has sent everything. Meanwhile messages wait in the queue of that
subscriber, and the oldest one is dropped and counted if there are too many. A subscriber with a full queue lets
publishers wait, unless it has read nothing for SLOW_S: then it is slow, and only loses messages.
"""

import asyncio
from collections import deque

from r2p.clock import real_clock, real_time
from r2p.ros.middleware import RosEndpoint
from r2p.ros.ros1.connections import Ros1Context, TcprosConnection, take_over
from r2p.ros.ros1.tcpros import Fields, encode_header, frame, publisher_header, refuse_subscriber

SLOW_S = 1.0
"""Seconds without any progress after which publishers do not wait for a subscriber any more."""

QUEUE_BYTES_MAX = 64 << 20
"""Bytes that wait for one subscriber at most, whatever the depth of its queue; one message more if it is empty."""

_TURN_BYTES = 64 * 1024  # bytes that are gathered in one turn of the event loop before the socket is tried
_GATHER = 20_000  # ns after a message was sent in which another one waits for more: less than a round trip takes
TOO_SLOW = "ROS subscriber too slow"
"""The reason of messages that were dropped as a subscriber did not read them in time."""


class SubscriberConnection(TcprosConnection):
    """The connection of a remote subscriber, and the messages that wait for it."""

    def __init__(self, publication: "Ros1Publication", node: str) -> None:
        super().__init__(publication.context)
        self.node = node
        """The subscriber's node."""
        self.slow = False
        """True if it is not waited for."""
        self.dropped = 0
        self.sent = 0
        self.bytes_sent = 0
        self._publication = publication
        self._queue: deque[bytes] = deque()
        self._queued = 0  # bytes
        self._paused = False
        self._turn: list[bytes] | None = None  # what goes out at the end of this turn of the loop
        self._turn_bytes = 0
        self._timer: asyncio.TimerHandle | None = None
        self._unsent = 0  # bytes that the socket had not accepted when the timer was started
        self._emptied = False  # True if it has accepted all of them since
        self._loop = asyncio.get_running_loop()
        self._monotonic = real_clock().monotonic
        self._sent_at = self._monotonic() - _GATHER  # ns
        self._many = False  # True if several messages went out at the end of the last turn with any

    @property
    def topic(self) -> str:
        return self._publication.topic

    def send(self, data: bytes) -> None:
        """Send a frame, or let it wait.

        It goes out at once, unless one has gone out just now, or several did in the last turn of the loop: then it does
        at the end of this turn, with all that come until then.
        """
        if self._paused:
            self._keep(data)
        elif self._turn is not None:
            self._turn.append(data)
            self._turn_bytes += len(data)
            if self._turn_bytes > _TURN_BYTES:
                self._flush_turn()
        elif self._many or self._monotonic() - self._sent_at < _GATHER:
            self._turn = [data]
            self._loop.call_soon(self._end_turn)
        else:
            self._write(data, 1)

    @property
    def has_room(self) -> bool:
        """Return whether a message can be sent without dropping one."""
        depth = self._publication.depth
        return not self._paused or ((not depth or len(self._queue) < depth) and self._queued < QUEUE_BYTES_MAX)

    def data_received(self, data: bytes) -> None:
        """Ignore received bytes: subscribers send only a header."""

    def pause_writing(self) -> None:
        self._paused = True

    def resume_writing(self) -> None:
        self._paused = self.slow = False
        self._emptied = True
        queue = self._queue
        while queue and not self._paused:
            gathered, size = [], 0
            while queue and size < _TURN_BYTES:
                gathered.append(queue.popleft())
                size += len(gathered[-1])
            self._queued -= size
            self._write(b"".join(gathered), len(gathered))
        if self.has_room:
            self._unblock()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._unblock()
        waiting = len(self._queue) + len(self._turn or ())
        if waiting:
            self.context.lost["ROS subscriber gone"] += waiting
        self._queue.clear()
        if self._turn is not None:
            self._turn = []
        self._publication.left(self)

    def close(self) -> None:
        """Close the connection when everything that waits is sent."""
        self._flush_turn()
        if self.transport is not None and self._queue:
            self.transport.write(b"".join(self._queue))
            self._queue.clear()
        self._unblock()
        super().close()

    def _write(self, data: bytes, messages: int) -> None:
        if self.transport is not None:
            self.sent += messages
            self.bytes_sent += len(data)
            self._sent_at = self._monotonic()  # before the write: in its course, the other side may answer already
            self.transport.write(data)

    def _end_turn(self) -> None:
        self._many = len(self._turn or ()) > 1
        self._flush_turn()
        self._turn = None

    def _flush_turn(self) -> None:
        turn = self._turn
        if not turn:
            return
        self._turn, self._turn_bytes = [], 0
        if self._paused:
            for each in turn:
                self._keep(each)
        else:
            self._write(b"".join(turn), len(turn))

    def _keep(self, data: bytes) -> None:
        """Let a frame wait, and drop the oldest ones without room."""
        queue, depth = self._queue, self._publication.depth
        queue.append(data)
        self._queued += len(data)
        while (depth and len(queue) > depth) or (self._queued > QUEUE_BYTES_MAX and len(queue) > 1):
            self._queued -= len(queue.popleft())
            self.dropped += 1
            self.context.lost[TOO_SLOW] += 1
        if not self.slow and self._publication.waits and not self.has_room:
            self._block()

    # Publishers wait for a subscriber that reads

    def _block(self) -> None:
        if self._timer is None:
            self.context.block(self)
            self._arm()

    def _arm(self) -> None:
        self._unsent, self._emptied = self._unsent_now(), False
        with real_time():  # also of a program under virtual time
            self._timer = self._loop.call_later(SLOW_S, self._check_progress)

    def _unsent_now(self) -> int:
        return self.transport.get_write_buffer_size() if self.transport is not None else 0

    def _check_progress(self) -> None:
        if self._emptied or self._unsent_now() < self._unsent:
            self._arm()
            return
        self._unblock(slow=True)
        text = f"{self.node} reads [{self._publication.topic}] too slowly, or not at all: it loses messages"
        self.context.user.notice(f"slow subscriber: {self._publication.topic}", text, trouble=True)

    def _unblock(self, *, slow: bool = False) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
            self.slow = slow
            self.context.unblock(self)


class Ros1Publication:
    """A topic that a node publishes."""

    def __init__(self, endpoint: RosEndpoint, context: Ros1Context) -> None:
        self.context = context
        self.endpoint = endpoint
        self.connections: list[SubscriberConnection] = []
        self.last: bytes | None = None
        """The frame of the last message, if the topic is latched."""
        self._latched = endpoint.qos.transient_local

    @property
    def topic(self) -> str:
        return self.endpoint.topic

    @property
    def depth(self) -> int:
        """Messages that wait for each subscriber at most; 0: as many as fit."""
        return self.endpoint.qos.depth

    @property
    def waits(self) -> bool:
        """Return whether publishers wait for subscribers without room."""
        return self.endpoint.qos.reliable

    def change(self, endpoint: RosEndpoint) -> None:
        """Go on with another quality of service; the type is the same."""
        self.endpoint = endpoint
        self._latched = endpoint.qos.transient_local
        if not self._latched:
            self.last = None

    def publish(self, data: bytes | memoryview) -> None:
        """Send a message to all subscribers."""
        framed = frame(data)
        if self._latched:
            self.last = framed
        for connection in self.connections:
            connection.send(framed)

    def accept(self, fields: Fields, connection: TcprosConnection) -> str:
        """Accept a subscriber; return why not, or an empty text."""
        node, topic, kind = self.endpoint.node, self.endpoint.topic, self.endpoint.type
        refusal = refuse_subscriber(fields, node, topic, kind)
        if not refusal:
            subscriber = SubscriberConnection(self, fields["callerid"])
            take_over(connection, subscriber, lambda: self._join(subscriber))
        return refusal

    def left(self, connection: SubscriberConnection) -> None:
        """Note that a connection is gone."""
        if connection in self.connections:
            self.connections.remove(connection)
            self.context.left(self.topic)

    def close(self) -> None:
        """Close all connections when what waits is sent."""
        for connection in list(self.connections):
            connection.close()

    def _join(self, connection: SubscriberConnection) -> None:
        assert connection.transport is not None
        node, kind, qos = self.endpoint.node, self.endpoint.type, self.endpoint.qos
        header = publisher_header(node, self.topic, kind, latching=qos.transient_local)
        connection.transport.write(encode_header(header))
        self.connections.append(connection)
        if self.last is not None:
            connection.send(self.last)
        self.context.joined(self.topic)
