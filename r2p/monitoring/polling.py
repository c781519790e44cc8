"""Asks modules for their statistics, each by a task of its own, so one by a slow link delays no other.

A module whose answer takes long is asked less often. On RTCAN, on serial lines, and behind gateways, answers take
capacity from the robot: there a module whose answer takes longer than 5 ms is asked less often than once a second, and
each 10 s if it takes 50 ms or more. Only the second question follows soon on the first: a rate needs two answers.
"""

import asyncio
import contextlib
from collections.abc import Callable

from r2p.codecs.own_services import WIRE_MIN
from r2p.errors import Closed, Error
from r2p.modules.graph import ModuleView
from r2p.modules.module import Module
from r2p.modules.statistics import ModuleStatistics
from r2p.units import SECOND

PERIOD = 1.0
"""Seconds between two questions, if answers are fast."""
RETRY = 5.0
"""Seconds until a module that does not answer is asked again."""

_NEAR_AT_ONCE = 8  # modules: together they answer as fast as a link takes answers
_REST = 1  # times as long as an answer took, nothing is asked ...
_REST_SLOW = 200  # ... where links may be slow, whose capacity is for the robot ...
_PERIOD_SLOW = 10.0  # s, ... but no longer than this, or than the former
_REST_FIRST = 4  # times as long as the first answer took, nothing is asked: the second one says rates


def can_be_asked(view: ModuleView) -> bool:
    """Return whether a module can be asked: this one, or a program with r2p that is not a tool."""
    if not view.link:
        return True
    return view.kind == "r2p" and view.state != "observer" and view.wire is not None and view.wire >= WIRE_MIN


class QuestionPace:
    """The pace at which one module, this one or another, is asked."""

    def __init__(self, module: Module, name: str) -> None:
        self.took = 0.0
        """Seconds that the last answer took."""
        self._module = module
        self._name = name

    async def pause(self, period: float = PERIOD) -> None:
        """Wait until the module may be asked again."""
        rest = _REST * self.took
        if not self.is_near():
            rest = max(rest, min(_REST_SLOW * self.took, _PERIOD_SLOW))
        await asyncio.sleep(max(period, rest))

    async def pause_first(self) -> None:
        """Wait after the first answer: a second one is needed for rates, so it is asked for soon."""
        await asyncio.sleep(max(PERIOD, _REST_FIRST * self.took))

    def is_near(self) -> bool:
        """Return whether a fast link leads to the module, without a gateway in between."""
        if self._name == self._module.name:
            return True
        for link in self._module.links:
            known = link.discovery.modules.get(self._name)
            if known is not None and not known.hops and link.up and not link.has_slots and link.calls.is_fast:
                return True
        return False


class StatisticsPolling:
    """Asks modules for their statistics, each by `run`."""

    def __init__(self, module: Module, period: float) -> None:
        self.period = period
        """Seconds between two questions to a module, at least."""
        self._module = module
        self._clock = module.space.clock
        self._turns = asyncio.Semaphore(_NEAR_AT_ONCE)

    async def run(
        self, name: str, on_answer: Callable[[ModuleStatistics | bytes], None], on_silence: Callable[[str], None]
    ) -> None:
        """Ask a module again and again, until cancelled.

        `on_answer` gets the content of its answers, and this module's own statistics as they are. It may raise
        DecodeError. `on_silence` gets the reason of a failure.
        """
        pace = QuestionPace(self._module, name)
        is_first = True
        while True:
            try:
                await self._ask(name, pace, on_answer)
            except Closed:
                return
            except (Error, TimeoutError) as error:
                on_silence(str(error))
                is_first = True
                await pace.pause(RETRY)
            else:
                await (pace.pause_first() if is_first else self._pause(pace))
                is_first = False

    async def _pause(self, pace: QuestionPace) -> None:
        """Wait until a module may be asked again; all near ones at the same time, so this process wakes up once."""
        period = self.period
        if pace.is_near():
            period = until_next(self._clock.monotonic() / SECOND, period)
        await pace.pause(period)

    async def _ask(self, name: str, pace: QuestionPace, on_answer: Callable[[ModuleStatistics | bytes], None]) -> None:
        if name == self._module.name:
            on_answer(self._module.statistics())
            return
        async with self._turns if pace.is_near() else contextlib.nullcontext():
            started = self._clock.monotonic()
            await self._module.network.read_statistics(name, on_answer)
            pace.took = (self._clock.monotonic() - started) / SECOND


def until_next(now: float, period: float) -> float:
    """Return the seconds from `now` until a multiple of the period: the first one that is at least half of one away."""
    rest = period - now % period
    return rest if rest >= period / 2 else rest + period
