"""When the tokens of others are believed: not while the link is down, and not that they went for a moment."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from r2p.protocols.presence import TOKENS

if TYPE_CHECKING:
    import asyncio

_SETTLE = 0.02
"""Seconds after which a token that went is believed to: when the network goes, tokens go a moment before it."""


class Tokens:
    """The tokens of a link as zenoh tells of them; `believed(key, there)` gets what is to be taken for true."""

    def __init__(self, loop: "asyncio.AbstractEventLoop", believed: Callable[[str, bool], None]) -> None:
        self._loop = loop
        self._believed = believed
        self._up = False
        self._early: dict[str, None] = {}
        self._going: dict[str, asyncio.TimerHandle] = {}

    def changed(self, key: str, there: bool) -> None:
        """A token came or went."""
        if not self._up:
            if there and len(self._early) < TOKENS:
                self._early[key] = None
            else:
                self._early.pop(key, None)
        elif there:
            timer = self._going.pop(key, None)
            if timer is not None:
                timer.cancel()
            self._believed(key, True)
        elif key not in self._going:
            self._going[key] = self._loop.call_later(_SETTLE, self._gone, key)

    def went_up(self) -> None:
        """The link is up: what came before is there."""
        self._up = True
        early, self._early = self._early, {}
        for key in early:
            self._believed(key, True)

    def went_down(self) -> None:
        """It is down, or closed: nothing that goes now has gone by itself."""
        self._up = False
        for timer in self._going.values():
            timer.cancel()
        self._going.clear()

    def _gone(self, key: str) -> None:
        del self._going[key]
        self._believed(key, False)
