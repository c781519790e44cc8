"""What the parts of one engine share: settings, the cycle, timers, actions to return, counters."""

from collections import Counter
from collections.abc import Hashable, Iterator

from r2p.protocols.rtcan.cycle import Cycle, timing
from r2p.protocols.rtcan.events import Action, Done, EngineSettings, Fate
from r2p.protocols.timers import KeyedTimers
from r2p.units import NEVER


class Timers(KeyedTimers):
    """As `KeyedTimers`, and keeps the next deadline: the engine asks for it after each frame, it seldom changes."""

    def __init__(self) -> None:
        super().__init__()
        self.due = NEVER
        """The instant at which the next key expires, or NEVER."""

    def set(self, key: Hashable, due: int) -> None:
        super().set(key, due)
        self._update()

    def clear(self, key: Hashable) -> None:
        super().clear(key)
        self._update()

    def pop(self, now: int) -> Iterator[Hashable]:
        for key in super().pop(now):
            self._update()
            yield key

    def _update(self) -> None:
        due = self.next()
        self.due = NEVER if due is None else due


class EngineContext:
    """The shared state of one engine. Raises ValueError for slots that are too short."""

    def __init__(self, settings: EngineSettings) -> None:
        self.settings = settings
        self.timing = timing(settings.slots, settings.cycle, settings.bit_rate)
        self.cycle = Cycle(self.timing, settings.receive_latency)
        self.timers = Timers()
        self.actions: list[Action] = []
        """What the owner of the engine has to do next, in order."""
        self.counts: Counter[str] = Counter()
        self._draws = 0

    def draw(self, below: int) -> int:
        """The next random number below this one. All follow from `settings.number`, so that a run can be repeated."""
        self._draws += 1
        return _mix(self.settings.number + self._draws) % below

    def report(self, handle: Hashable, fate: Fate, *, missed: bool, at: int) -> None:
        """A message was sent, or given up."""
        if missed:
            self.counts["missed"] += 1
        if handle is not None:
            self.actions.append(Done(handle, fate, missed, at))


def _mix(number: int) -> int:
    """Splitmix64: numbers that look random, from consecutive ones."""
    number = (number * 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
    number = ((number ^ number >> 30) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
    number = ((number ^ number >> 27) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
    return number ^ number >> 31
