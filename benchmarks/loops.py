"""Running a coroutine on an event loop of choice."""

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any, TypeVar

import uvloop

T = TypeVar("T")

FACTORIES = {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}


def precise() -> asyncio.AbstractEventLoop:
    """One whose timers are of microseconds, not of whole milliseconds: a simulated bus has several for each frame."""
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


def run_on(loop: str, main: Coroutine[Any, Any, T]) -> T:
    with asyncio.Runner(loop_factory=(FACTORIES | {"precise": precise})[loop]) as runner:
        return runner.run(main)
