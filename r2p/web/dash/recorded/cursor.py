"""The instant of a recording that a page shows: it stands, or runs at a rate."""

import asyncio

from r2p.errors import WebError
from r2p.units import SECOND

RATE_MIN, RATE_MAX = 0.01, 1000.0


class Cursor:
    """An instant between the start and the end of a recording (ns)."""

    def __init__(self, start: int, end: int) -> None:
        self.start, self.end = start, end
        self.rate = 1.0
        self.playing = False
        self._time = end
        self._began = 0.0  # by the clock of the event loop, when the time was this one

    @property
    def time(self) -> int:
        """The instant now (ns)."""
        if not self.playing:
            return self._time
        elapsed = asyncio.get_running_loop().time() - self._began
        return min(self._time + int(elapsed * self.rate * SECOND), self.end)

    def seek(self, time: int) -> None:
        """Go to an instant (ns), or to the end that is nearest to it."""
        self._time = min(max(time, self.start), self.end)
        self._began = asyncio.get_running_loop().time()

    def play(self, rate: float) -> None:
        """Run at a rate, from the start if it is at the end; 0: stop. Raises WebError for an impossible rate."""
        if rate and not RATE_MIN <= rate <= RATE_MAX:
            raise WebError(f"a recording is played at a rate of {RATE_MIN} to {RATE_MAX:g}, not {rate:g}; 0 stops it")
        self.seek(self.time)
        if not rate:
            self.playing = False
            return
        if self._time >= self.end:
            self._time = self.start
        self.rate, self.playing = rate, True

    def stop_at_end(self) -> None:
        """Stop if the end is reached."""
        if self.playing and self.time >= self.end:
            self._time, self.playing = self.end, False
