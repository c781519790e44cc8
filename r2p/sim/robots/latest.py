"""What the nodes of a control chain share; it uses only the public API.

A node of the chain keeps the newest message of each input (`Latest`), and sends its output (`sender`): periodically if
it is hard real-time, otherwise with each new input.
"""

from collections.abc import Callable
from typing import Generic, Literal, TypeVar

import r2p

M = TypeVar("M", bound=r2p.Message)

_DEADLINE = 0.05  # seconds, of soft real-time messages

Traffic = Literal["hrt", "srt", "nrt"]
"""How messages are sent: hard real-time (`Periodic`), soft real-time (`Sporadic`), non real-time."""


class Latest(Generic[M]):
    """The newest message of a topic, while it is fresh; `changed` is called for each, in the node's task."""

    def __init__(
        self,
        node: r2p.Node,
        topic: str,
        type: type[M],
        *,
        fresh: float,
        changed: Callable[[], object] = lambda: None,
    ) -> None:
        """`fresh` in seconds. The node has to `spin()`."""
        self._node = node
        self._fresh = round(fresh * 1e9)
        self._changed = changed
        self._message: M | None = None
        self._at = 0
        node.subscribe(topic, type, self._received, queue=1, lossy=True)

    @property
    def message(self) -> M | None:
        """The newest message; None if it is not fresh."""
        return self._message if self._node.now() - self._at <= self._fresh else None

    def _received(self, message: M) -> None:
        self._message = message
        self._at = self._node.now()
        self._changed()


def sender(
    node: r2p.Node, topic: str, type: type[M], fill: Callable[[], M | None], *, traffic: Traffic, period: float
) -> Callable[[], object]:
    """Publish what `fill` returns, None for nothing: every `period` seconds ("hrt"), or when the result is called."""
    if traffic == "hrt":
        node.advertise(topic, type, r2p.Periodic(period, fill))
        return lambda: None
    publisher = (
        node.advertise(topic, type, r2p.Sporadic(deadline=_DEADLINE))
        if traffic == "srt"
        else node.advertise(topic, type)
    )

    def send() -> None:
        message = fill()
        if message is not None:
            publisher.publish_nowait(message)

    return send
