"""What a program declares of a parameter, and how others see it.

`ParameterDefinition.convert` is the one place where a value is checked, whatever it comes from.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import msgspec

from r2p.codecs.parameters import ParameterKind, ParameterRecord, Plain
from r2p.errors import ParameterError
from r2p.names import parameter_name
from r2p.parameters.values import (
    CHOICE_MAX,
    CHOICES_MAX,
    NUMBERS_MAX,
    check_text,
    convert,
    kind_of,
    parse,
    plain,
    shown,
)

T = TypeVar("T")

UNIT_MAX = 16
"""Bytes of a unit in UTF-8."""
DOC_MAX = 120
"""Bytes of the description of a parameter in UTF-8."""

Check = Callable[[T], str | None] | Callable[[T, Mapping[str, Any]], str | None]
"""Returns None for a value that is fine, or a text that says why it is refused.

One that takes a second argument also gets the values that all parameters of the node would have then, by name.
"""

_NUMBERS = (ParameterKind.INT, ParameterKind.FLOAT, ParameterKind.INTS, ParameterKind.FLOATS)


class ParameterInfo(ParameterRecord, frozen=True, kw_only=True):
    """A parameter of a module, as other modules and tools see it: `NetworkView.parameters`.

    `kind` is "bool", "int", "float", "str", "enum", "ints" or "floats". Values (`Plain`) are of that type, tuples of
    int or float; that of an enum is its name, and `choices` are all of them.

    `origin` says where the value comes from: "code", "saved file", "r2p.toml", "--params", "--param", "params=", "run
    time" (set over the network, or by another node) or "program" (set by its own node).

    `saved` is what the module's file has for it; None: nothing. `problem` says why that is not used, if it does not
    fit.
    """

    module: str

    @property
    def full_name(self) -> str:
        """MODULE/NODE.NAME, as errors name it."""
        return f"{self.module}/{self.node}.{self.name}"

    def parse(self, text: str) -> Plain:
        """Return the value that a text stands for: `0.7`, `true`, `1,2,3`, `AUTO`. Raises ParameterError."""
        try:
            return parse(ParameterKind[self.kind.upper()], text)  # type: ignore[return-value]
        except ParameterError as error:
            raise refused(self.full_name, text, str(error)) from None


class ParameterDefinition(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter as it was declared. Made by `define_parameter`."""

    label: str
    """MODULE/NODE.NAME, for errors."""
    name: str
    kind: ParameterKind
    default: Any
    minimum: float | None = None
    maximum: float | None = None
    unit: str = ""
    doc: str = ""
    read_only: bool = False
    check: Callable[..., str | None] | None = None
    check_sees_all: bool = False
    """Whether `check` also takes the values of the node's other parameters."""

    @property
    def choices(self) -> tuple[str, ...]:
        """The names of an enum's members; empty for other kinds."""
        return tuple(each.name for each in type(self.default)) if self.kind is ParameterKind.ENUM else ()

    def convert(self, value: object) -> Any:
        """Return a value as the type of the default. Raises ParameterError, which names the parameter and the limit."""
        try:
            converted = convert(self.kind, value, like=self.default)
            self._check_limits(converted)
        except ParameterError as error:
            raise refused(self.label, value, str(error)) from None
        return converted

    def parse(self, text: str) -> Any:
        """Return the value that a text of the command line stands for. Raises ParameterError."""
        try:
            value = parse(self.kind, text)
        except ParameterError as error:
            raise refused(self.label, text, str(error)) from None
        return self.convert(value)

    def verify(self, value: Any, values: Mapping[str, Any]) -> None:
        """Ask the program's `check`; `values` are those that all parameters of the node would have.

        Raises ParameterError with the text of the check.
        """
        if self.check is None:
            return
        try:
            text = self.check(value, values) if self.check_sees_all else self.check(value)
        except ValueError as error:
            raise refused(self.label, value, str(error) or "its check refuses it") from error
        except Exception as error:
            raise refused(self.label, value, f"its check raised {error!r}") from error
        if text is None:
            return
        if not isinstance(text, str):
            text = f"its check returned {text!r}: write one that returns None, or a text that says why not"
        raise refused(self.label, value, text or "its check refuses it")

    def _check_limits(self, value: Any) -> None:
        unit = f" {self.unit}" if self.unit else ""
        for each in value if isinstance(value, tuple) else (value,):
            if self.minimum is not None and each < self.minimum:
                raise ParameterError(f"it takes {self.minimum!r}{unit} or more")
            if self.maximum is not None and each > self.maximum:
                raise ParameterError(f"it takes {self.maximum!r}{unit} or less")


def refused(label: str, value: object, reason: str) -> ParameterError:
    """Return the error for a value that a parameter can't have."""
    return ParameterError(f"{label} = {shown(plain(value))}: {reason}")


def define_parameter(
    owner: str,
    name: str,
    default: Any,
    *,
    min: float | None,
    max: float | None,
    unit: str,
    doc: str,
    check: Callable[..., str | None] | None,
    read_only: bool,
) -> ParameterDefinition:
    """Return a definition; `owner` is MODULE/NODE. Raises ParameterError for one that makes no sense, and InvalidName
    or NameTooLong for the name.
    """
    label = f"{owner}.{parameter_name(name)}"
    try:
        definition = ParameterDefinition(
            label=label,
            name=name,
            kind=kind_of(default),
            default=default,
            minimum=min,
            maximum=max,
            unit=check_text("its unit", unit, UNIT_MAX),
            doc=check_text("its doc", doc, DOC_MAX),
            read_only=read_only,
            check=check,
            check_sees_all=check is not None and _arguments(check) > 1,
        )
        return _checked(definition)
    except ParameterError as error:
        text = str(error)
        raise ParameterError(text if text.startswith(label) else f"parameter {label}: {text}") from None


def _checked(definition: ParameterDefinition) -> ParameterDefinition:
    kind, low, high = definition.kind, definition.minimum, definition.maximum
    if (low is not None or high is not None) and kind not in _NUMBERS:
        raise ParameterError(f"a {kind.text} has neither min nor max: leave them out")
    limits = [_limit(kind, each) for each in (low, high)]
    if low is not None and high is not None and low > high:
        raise ParameterError(f"min {low!r} is above max {high!r}")
    if kind is ParameterKind.ENUM:
        _check_choices(definition.choices)
    if isinstance(definition.default, tuple) and len(definition.default) > NUMBERS_MAX:
        raise ParameterError(f"a tuple has at most {NUMBERS_MAX} numbers, not {len(definition.default)}")
    converted = msgspec.structs.replace(definition, minimum=limits[0], maximum=limits[1])
    return msgspec.structs.replace(converted, default=converted.convert(definition.default))


def _limit(kind: ParameterKind, limit: float | None) -> float | None:
    """Return a limit as a number of the parameter's kind: the limits of a float are floats."""
    if limit is None:
        return None
    whole = kind in (ParameterKind.INT, ParameterKind.INTS)
    try:
        number: float = convert(ParameterKind.INT if whole else ParameterKind.FLOAT, limit, like=None)
    except ParameterError as error:
        raise ParameterError(f"a limit of {shown(limit)}: {error}") from None
    return number


def _check_choices(names: tuple[str, ...]) -> None:
    if len(names) > CHOICES_MAX:
        raise ParameterError(f"its enum has {len(names)} members, at most {CHOICES_MAX} are possible")
    for name in names:
        check_text(f"the member {name} of its enum", name, CHOICE_MAX)


def _arguments(check: Callable[..., object]) -> int:
    """Return how many arguments a check takes."""
    try:
        parameters = inspect.signature(check).parameters.values()
    except (TypeError, ValueError):  # of a function written in C
        return 1
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(each.kind in positional and each.default is each.empty for each in parameters)
