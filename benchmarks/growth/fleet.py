"""Processes that begin at the same instant, and say how much processor time they took."""

import asyncio
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection

from benchmarks.processes import process


class Fleet:
    """The pipes to some processes, each of which runs `report` beside its work."""

    def __init__(self, pipes: Sequence[Connection]) -> None:
        self.pipes = pipes

    def begin(self) -> None:
        """Wait until all have imported what they need, then let them begin."""
        for pipe in self.pipes:
            pipe.recv()
        for pipe in self.pipes:
            pipe.send("begin")

    def results(self) -> list[float]:
        """Return what each has reported."""
        return [pipe.recv() for pipe in self.pipes]

    def used(self) -> float:
        """Return the seconds of processor time that all have taken so far."""
        for pipe in self.pipes:
            pipe.send("used")
        return sum(self.results())

    def share(self, seconds: float) -> float:
        """Return how much of a core all take together, for `seconds` from now on."""
        began, before = time.perf_counter(), self.used()
        time.sleep(seconds)
        return (self.used() - before) / (time.perf_counter() - began)


@contextmanager
def fleet(target: Callable[..., object], arguments: Sequence[tuple[object, ...]]) -> Iterator[Fleet]:
    """Start a process for each of `arguments`, until the end of the block."""
    with ExitStack() as stack:
        yield Fleet([stack.enter_context(process(target, *each)) for each in arguments])


def ready(pipe: Connection) -> None:
    """Say that this process is ready, and wait until all are."""
    pipe.send("ready")
    pipe.recv()


async def serve_usage(pipe: Connection) -> None:
    """Answer each question with the processor time of this process, until its end."""
    loop, asked = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(pipe.fileno(), asked.set)
    while True:
        await asked.wait()
        asked.clear()
        while pipe.poll():
            pipe.recv()
            pipe.send(time.process_time())
