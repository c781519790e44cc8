"""Clean-up that is seen from outside: each place of a coroutine says whether an exception has led there."""

from __future__ import annotations

import contextlib
import types
from typing import TYPE_CHECKING, Any

import pytest

from r2p.modules.unwinding import cleans_up, ends

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Generator
    from typing import Self

WORK, CATCH, INNER, END = "works", "catches", "cleans up, and goes on", "cleans up, and ends"


@types.coroutine
def at(place: str) -> Generator[str, None, bool]:
    """Wait in a place of which this is known; False."""
    yield place
    return False


async def fail(place: str = WORK) -> None:
    await at(place)
    raise OSError


class Exits:
    def __init__(self, place: str = END) -> None:
        self._place = place

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await at(self._place)


async def numbers() -> AsyncIterator[int]:
    yield 1
    yield 2


async def in_finally() -> None:
    try:
        await fail()
    finally:
        await at(END)


async def in_a_helper() -> None:
    await in_finally()


async def in_except() -> None:
    try:
        await fail()
    except OSError:
        await at(CATCH)
        raise


async def in_bare_except() -> None:
    try:
        await fail()
    except:  # noqa: E722 - a shape of its own in compiled code
        await at(CATCH)


async def in_a_group() -> None:
    try:
        await fail()
    except* OSError:
        await at(CATCH)


async def after_except() -> None:
    try:
        try:
            await fail()
        except OSError as error:
            await at(CATCH)
            raise KeyError from error
    finally:
        await at(END)


async def in_a_with() -> None:
    async with Exits(), Exits() as _:
        with contextlib.nullcontext():
            await fail()


async def inside_a_retry() -> None:
    while True:
        try:
            try:
                await fail()
            finally:
                await at(INNER)
        except OSError:
            await at(CATCH)
            return


async def of_a_helper_inside_a_retry() -> None:
    async def helper() -> None:
        try:
            await fail()
        finally:
            await at(INNER)

    try:
        await helper()
    except OSError as error:
        await at(CATCH)
        del error


async def without_an_exception() -> None:
    try:
        await at(WORK)
    finally:
        await at(WORK)
    async with Exits(WORK):
        await at(WORK)


async def with_all_kinds_of_things_in_it() -> None:
    try:
        async for _ in numbers():
            await fail()
    finally:
        try:
            await fail(END)
        except OSError:
            await at(END)
        with contextlib.suppress(OSError):
            await fail(END)
        async for _ in numbers():
            await at(END)
        async with Exits():
            for _ in [number for number in (1, 2)]:  # noqa: C416 - a shape of its own in compiled code
                await at(END)
        while await at(END):
            pass  # pragma: no cover


async def in_a_finally_that_returns() -> int:
    try:
        await fail()
    finally:
        if not await at(END):
            return 3  # noqa: B012 - it may be done
    return 4  # pragma: no cover


async def in_an_async_generator() -> None:
    async for _ in cleaned_up():
        pass


async def cleaned_up() -> AsyncIterator[int]:
    try:
        yield 1
        await fail()
    finally:
        await at(END)


async def in_an_async_generator_that_is_closed() -> None:
    async def numbers() -> AsyncGenerator[int]:
        try:
            yield 1
        finally:
            await at(INNER)

    generator = numbers()
    await at(WORK)
    await anext(generator)
    await generator.aclose()
    await at(WORK)


async def in_a_context_manager_that_is_a_generator() -> None:
    @contextlib.asynccontextmanager
    async def managed() -> AsyncIterator[None]:
        try:
            yield
        finally:
            await at(END)

    async with managed():
        await fail()


async def in_a_generator_that_is_asked_with_a_default() -> None:
    generator = cleaned_up()
    await anext(generator, None)
    await anext(generator, None)


async def in_an_object_that_is_awaited() -> None:
    class Job:
        def __await__(self) -> Generator[Any, None, None]:
            return in_finally().__await__()

    await Job()


@pytest.mark.parametrize(
    "shape",
    [
        in_finally,
        in_a_helper,
        in_except,
        in_bare_except,
        in_a_group,
        after_except,
        in_a_with,
        inside_a_retry,
        of_a_helper_inside_a_retry,
        without_an_exception,
        with_all_kinds_of_things_in_it,
        in_a_finally_that_returns,
        in_an_async_generator,
        in_an_async_generator_that_is_closed,
        in_a_context_manager_that_is_a_generator,
        in_a_generator_that_is_asked_with_a_default,
        in_an_object_that_is_awaited,
    ],
)
def test_each_place_is_recognised(shape: Callable[[], Coroutine[Any, None, object]]) -> None:
    coroutine = shape()
    places = 0
    with contextlib.suppress(StopIteration, OSError, KeyError):
        while True:
            place = coroutine.send(None)
            assert ends(coroutine) == (place == END)
            assert cleans_up(coroutine) == (place in (INNER, END))
            assert cleans_up(coroutine, handlers=True) == (place != WORK)
            places += 1
    assert places >= 2


def test_a_coroutine_that_has_ended_or_not_begun_cleans_nothing_up() -> None:
    coroutine = in_finally()
    assert not cleans_up(coroutine)
    coroutine.close()
    assert not cleans_up(coroutine)
    assert not ends(None)


def test_what_is_remembered_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    known: dict[int, Any] = {}
    monkeypatch.setattr("r2p.modules.unwinding._known", known)
    monkeypatch.setattr("r2p.modules.unwinding._REMEMBERED", 2)
    for shape in (in_finally, in_except, in_a_with):
        coroutine = shape()
        with contextlib.suppress(StopIteration, OSError):
            while True:
                coroutine.send(None)
                ends(coroutine)
                assert 1 <= len(known) <= 2
