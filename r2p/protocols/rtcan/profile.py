"""What the modules on the bus expect: RTCAN with sync and claims, or firmware of 2014 (PROTOCOL.md 6, 7 and 9).

All firmware modules send management with the very same message id. Two that send at the same moment destroy each
other's frames; so on their networks management waits until nobody has sent any for a while, and for a random time more.
"""

from collections import Counter, deque
from collections.abc import Callable, Hashable

from r2p.protocols.rtcan.events import LONG_AGO, NEVER, Profile

QUIET = 33_000_000
"""ns without management traffic before any is sent."""
_SPREAD = 20_000_000
_MOST = 64


class Detector:
    """Finds out by listening whose network this is."""

    def __init__(self, wanted: Profile) -> None:
        self.profile = wanted
        self._wanted = wanted
        self._firmware = False

    def start(self) -> None:
        """Listen anew."""
        self.profile = self._wanted
        self._firmware = False

    def firmware_heard(self) -> None:
        """A frame with high byte 0 that is no sync was heard."""
        self._firmware = True

    def decide(self, *, synced: bool) -> None:
        """The time to listen is over; `synced` says whether there are sync frames."""
        if self.profile is Profile.AUTO:
            self.profile = Profile.FIRMWARE if self._firmware and not synced else Profile.RTCAN


class Pacer:
    """Management messages that wait for silence. `draw(n)` gives a random number below n."""

    def __init__(self, draw: Callable[[int], int], counts: Counter[str]) -> None:
        self._draw = draw
        self._counts = counts
        self.waiting: deque[tuple[bytes, Hashable]] = deque()
        """Messages and their handles, the next one first."""
        self._urgent = 0  # so many of them are urgent: the first ones
        self._quiet_from = LONG_AGO
        self._delay: int | None = None  # drawn when it is needed: most networks are not of firmware

    def put(self, data: bytes, *, urgent: bool = False, handle: Hashable = None) -> Hashable:
        """Send it when it is quiet, `urgent` ones first, in order.

        The oldest that is not urgent is dropped when there are too many: its handle comes back.
        """
        dropped: Hashable = None
        if len(self.waiting) >= _MOST:
            self._counts["management dropped"] += 1
            if self._urgent == len(self.waiting):
                return handle
            _, dropped = self.waiting[self._urgent]
            del self.waiting[self._urgent]
        if urgent:
            self.waiting.insert(self._urgent, (data, handle))
            self._urgent += 1
        else:
            self.waiting.append((data, handle))
        return dropped

    def traffic(self, now: int) -> None:
        """Somebody, or this node, sent a management frame."""
        self._quiet_from = now
        self._delay = None

    @property
    def due(self) -> int:
        """When the next one may go."""
        if not self.waiting:
            return NEVER
        if self._delay is None:
            self._delay = self._draw(_SPREAD)
        return self._quiet_from + QUIET + self._delay

    def pop(self, now: int) -> tuple[bytes, Hashable] | None:
        """What may go now, and its handle."""
        if self.due > now:
            return None
        self.traffic(now)
        self._urgent = max(0, self._urgent - 1)
        return self.waiting.popleft()

    def __len__(self) -> int:
        return len(self.waiting)

    def clear(self) -> list[Hashable]:
        """Forget all; their handles come back."""
        handles = [handle for _, handle in self.waiting]
        self.waiting.clear()
        self._urgent = 0
        return handles
