"""Detect that a coroutine waits in its clean-up: in a `finally`, or on its way out of an `async with`.

An exception on its way through a node's function can't be seen from outside before the function has ended, and
clean-up, such as stopping a motor, takes time. The only trace is the place where each frame waits: the compiler makes a
copy of each `finally` for the case of an exception. So this module looks the place up in the compiled code. For code
that it does not understand, the answer is no.
"""

import dis
import functools
import gc
import inspect
from collections.abc import Iterator
from types import CodeType, FrameType
from typing import NamedTuple

_CATCHES = ("CHECK_EXC_MATCH", "CHECK_EG_MATCH")
_REMEMBERED = 1024  # functions whose handlers are kept
_STEPS = {"async_generator_asend", "async_generator_athrow", "anext_awaitable", "coroutine_wrapper"}
"""Types between a coroutine and its awaitable that only the garbage collector can look into."""
_CLOSES = ("COPY", "POP_EXCEPT", "RERAISE")  # how the compiled code of each handler ends


class _Handler(NamedTuple):
    """The code of one `except`, `finally` or `with`, by offsets. A `finally` raises its exception again at `end`."""

    start: int
    end: int
    catches: bool


def ends(coroutine: object) -> bool:
    """Return whether the coroutine waits in a `finally` or `async with` after an exception that nothing catches."""
    return cleans_up(coroutine) and _uncaught(
        [(each.f_code, each.f_lasti) for each in frames(coroutine, closing=False)]
    )


def _uncaught(places: list[tuple[CodeType, int]]) -> bool:
    return any(
        _escapes(code, handler.end) and all(_escapes(*outer) for outer in places[:depth])
        for depth, (code, offset) in enumerate(places)
        for handler in _handlers(code)
        if not handler.catches and handler.start <= offset < handler.end
    )


def cleans_up(coroutine: object, *, handlers: bool = False) -> bool:
    """Return whether the coroutine waits in a `finally`, `async with` or (`handlers`) `except` after an exception.

    An `except` further out does not matter: clean-up is not to be disturbed in the middle of a program either.
    """
    for frame in frames(coroutine):
        offset = frame.f_lasti
        for handler in _handlers(frame.f_code):
            if handler.start <= offset < handler.end and (handlers or not handler.catches):
                return True
    return False


def frames(awaitable: object, *, closing: bool = True) -> Iterator[FrameType]:
    """Return the frames of all coroutines and generators of a chain, the outermost first.

    Without `closing`, up to an async generator that is being closed: GeneratorExit does not leave its `aclose`.
    """
    while awaitable is not None:
        if type(awaitable).__name__ in _STEPS:
            referents = gc.get_referents(awaitable)
            if not closing and type(awaitable).__name__ == "async_generator_athrow" and len(referents) == 1:
                return
            awaitable = next((each for each in referents if _waits(each)), None)
        elif inspect.iscoroutine(awaitable):
            frame, awaitable = awaitable.cr_frame, awaitable.cr_await
            if frame is not None:
                yield frame
        elif inspect.isasyncgen(awaitable):
            frame, awaitable = awaitable.ag_frame, awaitable.ag_await
            if frame is not None:
                yield frame
        else:
            return


def _waits(each: object) -> bool:
    return inspect.iscoroutine(each) or inspect.isasyncgen(each) or type(each).__name__ in _STEPS


_known: dict[int, tuple[CodeType, tuple[_Handler, ...]]] = {}
"""By identity, each kept alive by its entry: the hash of a code object takes longer than all the rest."""


def _handlers(code: CodeType) -> tuple[_Handler, ...]:
    known = _known.get(id(code))
    if known is None:
        if len(_known) >= _REMEMBERED:
            _known.clear()
        known = _known[id(code)] = code, _find_handlers(code)
    return known[1]


def _find_handlers(code: CodeType) -> tuple[_Handler, ...]:
    if not code.co_exceptiontable:
        return ()
    found: list[_Handler] = []
    opened: list[tuple[int, bool]] = []
    instructions = list(dis.get_instructions(code))
    for number, each in enumerate(instructions):
        if each.opname == "PUSH_EXC_INFO":
            opened.append((each.offset, instructions[number + 1].opname == "POP_TOP"))  # `except:` catches everything
        elif each.opname in _CATCHES and opened:
            opened[-1] = opened[-1][0], True
        elif opened and tuple(step.opname for step in instructions[number : number + 3]) == _CLOSES:
            start, catches = opened.pop()
            found.append(_Handler(start, instructions[number + 2].offset, catches))
    return () if opened else tuple(found)


@functools.lru_cache(maxsize=_REMEMBERED)
def _escapes(code: CodeType, offset: int) -> bool:
    """Return whether an exception raised at this offset leaves the function uncaught."""
    entries = dis.Bytecode(code).exception_entries  # type: ignore[attr-defined]  # since Python 3.11, unlisted
    by_start = {handler.start: handler for handler in _handlers(code)}
    for _ in range(len(entries) + 1):  # outwards: each step leaves one handler, so this ends
        target = next((each.target for each in entries if each.start <= offset < each.end), None)
        if target is None:
            return True
        handler = by_start.get(target)
        if handler is not None and handler.catches:
            return False
        offset = handler.end if handler is not None else _reraised(code, target)
    return False


def _reraised(code: CodeType, target: int) -> int:
    """Return the offset at which clean-up added by the compiler raises the exception again."""
    return next(
        each.offset
        for each in dis.get_instructions(code)
        if each.offset >= target and each.opname in ("RERAISE", "CLEANUP_THROW", "END_ASYNC_FOR")
    )
