"""The other end, in a process of its own."""

import multiprocessing
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection


@contextmanager
def process(target: Callable[..., object], *args: object) -> Iterator[Connection]:
    """Runs `target(pipe, *args)` until the end of the block; gives the other end of that pipe."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    child = context.Process(target=target, args=(there, *args), daemon=True)
    child.start()
    there.close()  # so the end of the child is the end of the pipe
    try:
        yield here
    finally:
        child.terminate()
        child.join()
