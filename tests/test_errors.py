"""The tree of exceptions: what may be caught as what."""

import inspect

import pytest

from r2p import errors
from r2p.errors import (
    Broken,
    Closed,
    Deadlock,
    DecodeError,
    Error,
    InvalidName,
    MessageError,
    NameTooLong,
    NodeCrashed,
    ParameterError,
    TransportError,
    TypeMismatch,
)

EVERY = [value for value in vars(errors).values() if inspect.isclass(value) and value.__module__ == errors.__name__]


@pytest.mark.parametrize(
    ("error", "bases"),
    [
        (InvalidName, (Error, ValueError)),
        (NameTooLong, (InvalidName,)),
        (MessageError, (Error, ValueError)),
        (DecodeError, (Error, ValueError)),
        (TypeMismatch, (Error, TypeError)),
        (TransportError, (Error,)),
        (Closed, (TransportError,)),
        (Broken, (TransportError,)),
        (NodeCrashed, (Error, ExceptionGroup)),
        (ParameterError, (Error, ValueError)),
        (Deadlock, (Error,)),
    ],
)
def test_is_caught_as(error: type[Exception], bases: tuple[type[Exception], ...]) -> None:
    assert all(issubclass(error, base) for base in bases)


def test_all_are_one_tree_and_in_its_picture() -> None:
    assert all(issubclass(error, Error) for error in EVERY)
    assert all(f" {error.__name__}" in str(errors.__doc__) for error in EVERY)
    assert all(error.__doc__ for error in EVERY)


def test_closed_is_not_broken() -> None:
    assert not issubclass(Closed, Broken)
    assert not issubclass(Broken, Closed)
    assert not issubclass(MessageError, DecodeError)


def test_node_crashed_is_a_group() -> None:
    reasons = [ValueError("one"), KeyError("two")]
    crashed = NodeCrashed("2 nodes crashed", reasons)
    assert crashed.exceptions == tuple(reasons)
    with pytest.raises(Error):
        raise crashed
    caught: list[Exception] = []
    try:
        raise crashed
    except* KeyError as group:
        caught.extend(group.exceptions)
    except* ValueError as group:
        caught.extend(group.exceptions)
    assert sorted(map(repr, caught)) == ["KeyError('two')", "ValueError('one')"]
