"""When the tokens of others are believed: not while the link is down, and not that they went for a moment."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from r2p.protocols.presence import TOKENS

if TYPE_CHECKING:
    import asyncio

_SETTLE = 0.02
"""Seconds after which a token that went is believed to: when the network goes, tokens go a moment before it."""


class Tokens:
    """The tokens of a link as zenoh tells of them; `believed(key, there)` gets what is to be taken for true, and
    `refused` is called for each that has no room before the link is up.
    """

    def __init__(
        self,
        loop: "asyncio.AbstractEventLoop",
        believed: Callable[[str, bool], None],
        refused: Callable[[], None],
    ) -> None:
        self._loop = loop
        self._believed = believed
        self._refused = refused
        self._up = False
        self._early: dict[str, None] = {}
        self._going: dict[str, asyncio.TimerHandle] = {}
        self._went: set[str] | None = None  # during a look: answers about these may be older than their end

    def changed(self, key: str, there: bool) -> None:
        """A token came or went."""
        if not self._up:
            self._changed_early(key, there)
        elif there:
            timer = self._going.pop(key, None)
            if timer is not None:  # it has not gone
                timer.cancel()
            else:
                self._believed(key, True)
        elif key not in self._going:
            self._going[key] = self._loop.call_later(_SETTLE, self._gone, key)
            self._note_end(key)

    def look(self) -> None:
        """All tokens are asked for: what goes from now on is newer than the answers."""
        self._went = set(self._going)

    def found(self, key: str) -> None:
        """A token is among the answers."""
        if self._went is not None and key not in self._went:
            self._believed(key, True)

    def looked(self) -> bool:
        """All answers have come. Says whether they could be used."""
        usable, self._went = self._went is not None, None
        return usable

    def went_up(self) -> None:
        """The link is up: what came before is there."""
        self._up = True
        early, self._early = self._early, {}
        for key in early:
            self._believed(key, True)

    def went_down(self) -> None:
        """It is down, or closed: nothing that goes now has gone by itself."""
        self._up = False
        self._went = None
        for timer in self._going.values():
            timer.cancel()
        self._going.clear()

    def _changed_early(self, key: str, there: bool) -> None:
        if not there:
            self._early.pop(key, None)
        elif key in self._early or len(self._early) < TOKENS:
            self._early[key] = None
        else:
            self._refused()

    def _note_end(self, key: str) -> None:
        if self._went is not None:
            self._went.add(key)
            if len(self._went) > TOKENS:  # too many to remember: the answers are of no use
                self._went = None

    def _gone(self, key: str) -> None:
        del self._going[key]
        self._believed(key, False)
