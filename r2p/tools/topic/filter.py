"""`r2p topic echo --filter`: expressions over the fields of a message, such as `x > 3 and stamp.sec % 2 == 0`.

An expression has the syntax of Python, but Python never runs it: it is parsed, and what is allowed becomes nested
functions, once for each type. There are no names but fields, no attributes but fields of fields, and no calls but those
of `FUNCTIONS`.

Its cost is bounded: its text is short, nothing can be assigned, only numbers can be calculated with (so no text or list
is ever repeated), and integers have at most `BITS_MAX` bits.
"""

import ast
import contextlib
import difflib
import functools
import math
import operator
import re
import warnings
from collections.abc import Callable, Iterator, Sized
from typing import Any

from r2p.errors import Error
from r2p.messages import Array, FixedArray, Layout, Message, Nested, Scalar, Shape, VariableArray, layout
from r2p.messages.values import shortest_f32

LENGTH_MAX = 1000
"""Characters of an expression."""
DEPTH_MAX = 60
"""Levels of an expression; parentheses are none, but a sum of n terms has n."""
BITS_MAX = 128
"""Bits of an integer, and the largest exponent and shift."""

_JOIN = "join conditions with and, or, not"
_DIGITS_MAX = 20  # decimals of round()
_MISTAKES = {
    re.compile(r"&&|\|\||!(?!=)"): "write and, or, not",
    re.compile(r"(?<![<>=!:])=(?!=)"): "write == to compare",
}
_UNDEFINED = (ArithmeticError, ValueError, IndexError)  # the expression has no value for this message

Evaluate = Callable[[Any], Any]
"""Returns the value of an expression for a message."""


class FilterError(Error):
    """An expression is invalid, or does not fit the type of the messages."""


class Filter:
    """An expression that messages pass or not, and how many did. Raises FilterError for an invalid expression."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.passed = 0
        self.rejected = 0
        """Messages that did not pass, also those for which the expression is undefined."""
        self.undefined = 0
        self.reason = ""
        """Why it was undefined for the last of these, such as "division by zero"."""
        self._expression = _parsed(text)
        self._cls: type[Message] | None = None
        self._evaluate: Evaluate = bool

    def bind(self, cls: type[Message]) -> None:
        """Prepare for messages of this type. Raises FilterError for unknown fields and for values that don't fit."""
        shape = layout(cls)
        try:
            self._evaluate = _Compiler(shape).value(self._expression)
            with contextlib.suppress(*_UNDEFINED):
                self._evaluate(shape.zero)
        except TypeError as error:
            raise self._misfit(error) from error
        self._cls = cls

    def passes(self, message: Message) -> bool:
        """Return whether a message passes, and count it. Raises FilterError as `bind` does."""
        if type(message) is not self._cls:
            self.bind(type(message))
        try:
            passed = bool(self._evaluate(message))
        except _UNDEFINED as error:
            passed = False
            self.undefined += 1
            self.reason = str(error)
        except TypeError as error:  # in a branch that `bind` has not come to
            raise self._misfit(error) from error
        self.passed += passed
        self.rejected += not passed
        return passed

    @property
    def seen(self) -> int:
        return self.passed + self.rejected

    @property
    def summary(self) -> str:
        """The number of messages that passed."""
        text = f"{self.passed} of {self.seen} messages passed the filter"
        return f"{text}; it was undefined for {self.undefined}: {self.reason}" if self.undefined else text

    def _misfit(self, error: TypeError) -> FilterError:
        return FilterError(f"filter {self.text!r}: {error}")


def _parsed(text: str) -> ast.expr:
    if len(text) > LENGTH_MAX:
        raise FilterError(f"a filter has at most {LENGTH_MAX} characters, not {len(text)}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what is rejected anyway
            tree = ast.parse(text.strip(), mode="eval").body
    except SyntaxError as error:
        advice = [f"; {advice}" for mistake, advice in _MISTAKES.items() if mistake.search(text)]
        raise FilterError(f"filter {text!r}: {error.msg}{''.join(advice[:1])}") from error
    except (ValueError, RecursionError, MemoryError) as error:
        raise FilterError(f"filter {text!r}: {str(error) or 'nested too deeply'}") from error
    if _depth(tree) > DEPTH_MAX:
        raise FilterError(f"filter {text!r}: more than {DEPTH_MAX} levels deep")
    return tree


def _depth(tree: ast.AST) -> int:
    depth, level = 0, [tree]
    while level:
        depth += 1
        level = [child for node in level for child in ast.iter_child_nodes(node)]
    return depth


class _Compiler:
    """Turns expressions over the fields of one type into functions. Raises FilterError for what is not allowed."""

    def __init__(self, shape: Layout[Any]) -> None:
        self._layout = shape

    def value(self, node: ast.expr) -> Evaluate:
        """Return the function for any expression."""
        match node:
            case ast.UnaryOp(op=op, operand=operand):
                return self._apply(_UNARY[type(op)], [operand])
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
                return self._apply(_BINARY[type(op)], [left, right])
            case ast.BoolOp(op=op, values=values):
                return self._joined(all if isinstance(op, ast.And) else any, values)
            case ast.Compare(left=left, ops=ops, comparators=others) if all(type(op) in _COMPARISONS for op in ops):
                return self._comparison([left, *others], [_COMPARISONS[type(op)] for op in ops])
            case ast.Call(func=ast.Name(id="len"), args=[ast.Name() | ast.Attribute() | ast.Subscript() as field]):
                get, _ = self._value_path(field)  # not converted: it may have a million elements
                return lambda message: len(get(message))
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in FUNCTIONS:
                return self._apply(FUNCTIONS[name], arguments)
            case ast.Call(func=function):
                known = ", ".join(FUNCTIONS)
                raise FilterError(f"{ast.unparse(function)}() is not allowed in a filter; the functions are {known}")
        return self._operand(node)

    def _operand(self, node: ast.expr) -> Evaluate:
        match node:
            case ast.Constant(value=bool() | int() | float() | str() as constant):
                return _constant(constant)
            case ast.Name(id=name) if name in _CONSTANTS and self._find(Nested(self._layout), name) is None:
                return _constant(_CONSTANTS[name])
            case ast.Name() | ast.Attribute() | ast.Subscript():
                return self._leaf(node)
            case ast.Tuple(elts=items) | ast.List(elts=items) | ast.Set(elts=items):
                return self._apply(lambda *values: values, items)
        raise FilterError(f"{ast.unparse(node)!r} is not allowed in a filter")

    def _apply(self, function: Callable[..., Any], operands: list[ast.expr]) -> Evaluate:
        values = [self.value(each) for each in operands]
        return lambda message: _bounded(function(*[value(message) for value in values]))

    def _joined(self, join: Callable[[Iterator[Any]], bool], operands: list[ast.expr]) -> Evaluate:
        values = [self.value(each) for each in operands]
        return lambda message: join(value(message) for value in values)

    def _comparison(self, operands: list[ast.expr], tests: list[Callable[[Any, Any], bool]]) -> Evaluate:
        """Return the function for `a < b <= c`."""
        if len(tests) > 1 and any(isinstance(each, ast.BinOp) and type(each.op) in _BITWISE for each in operands):
            raise FilterError(f"{_JOIN}, not with &, |, ^")  # `x > 3 & n < 2` means `x > (3 & n) < 2`
        first, *others = [self.value(each) for each in operands]

        def evaluate(message: Any) -> bool:
            left = first(message)
            for test, other in zip(tests, others, strict=True):
                right = other(message)
                if not test(left, right):
                    return False
                left = right
            return True

        return evaluate

    # Fields

    def _leaf(self, node: ast.expr) -> Evaluate:
        """Return the function for the value of a field, as `echo` prints it; only what is not finite stays a float."""
        get, shape = self._value_path(node)
        convert = _converter(shape)
        return get if convert is None else lambda message: convert(get(message))

    def _value_path(self, node: ast.expr) -> tuple[Evaluate, Shape]:
        """Return the function for what is at a path that ends at a value, unconverted, and its shape."""
        get, shape = self._path(node)
        if isinstance(shape, Nested):
            names = (f"{ast.unparse(node)}.{field.name}" for field in shape.layout.fields)
            raise FilterError(f"{ast.unparse(node)} has fields: write {' or '.join(names)}")
        return get, shape

    def _path(self, node: ast.expr) -> tuple[Evaluate, Shape]:
        """Return the function for what is at a path, unconverted, and its shape."""
        match node:
            case ast.Name(id=name):
                return operator.attrgetter(name), self._field(node, Nested(self._layout), name)
            case ast.Attribute(value=inner, attr=name):
                get, shape = self._path(inner)
                return lambda message: getattr(get(message), name), self._field(node, shape, name)
            case ast.Subscript(value=inner, slice=ast.Slice(lower, upper, step)):
                get, array = self._array(inner)
                ends = [_constant(None) if each is None else self.value(each) for each in (lower, upper, step)]
                return lambda message: get(message)[slice(*[end(message) for end in ends])], array
            case ast.Subscript(value=inner, slice=index):
                get, array = self._array(inner)
                count = array.count if isinstance(array, FixedArray) else array.limit
                if isinstance(index, ast.Constant) and isinstance(index.value, int) and index.value >= count:
                    most = "" if isinstance(array, FixedArray) else "at most "
                    raise FilterError(f"{ast.unparse(node)}: {ast.unparse(inner)} has {most}{count} values, from 0 on")
                at = self.value(index)
                return lambda message: get(message)[at(message)], array.item
        raise FilterError(f"{ast.unparse(node)!r} is not a field")

    def _array(self, node: ast.expr) -> tuple[Evaluate, FixedArray | VariableArray]:
        get, shape = self._path(node)
        if not isinstance(shape, FixedArray | VariableArray):
            raise FilterError(f"{ast.unparse(node)} is not an array")
        return get, shape

    def _field(self, node: ast.expr, shape: Shape, name: str) -> Shape:
        found = self._find(shape, name)
        if found is None:
            raise self._unknown(ast.unparse(node))
        return found

    @staticmethod
    def _find(shape: Shape, name: str) -> Shape | None:
        fields = shape.layout.fields if isinstance(shape, Nested) else ()
        return next((field.shape for field in fields if field.name == name), None)

    def _unknown(self, path: str) -> FilterError:
        paths = list(_paths(self._layout))
        close = [each for each in paths if each.rpartition(".")[2] == path]
        close = close or difflib.get_close_matches(path, paths, n=1)
        advice = f"did you mean {' or '.join(close)}?" if close else f"the fields are {', '.join(paths)}"
        return FilterError(f"{self._layout.cls.__name__} has no field {path}; {advice}")


def _paths(shape: Layout[Any]) -> Iterator[str]:
    """Yield the paths of all fields."""
    for field in shape.fields:
        inner, path = field.shape, field.name
        while isinstance(inner, FixedArray | VariableArray):
            inner, path = inner.item, f"{path}[0]"
        if isinstance(inner, Nested):
            yield from (f"{path}.{each}" for each in _paths(inner.layout))
        else:
            yield field.name


def _converter(shape: Shape) -> Evaluate | None:
    """Return what makes the value of a field the one that `echo` prints; None: it is that one."""
    match shape:
        case Scalar("f32"):
            return lambda value: shortest_f32(value) if math.isfinite(value) else value
        case FixedArray(item) | VariableArray(item) if (convert := _converter(item)) is not None:
            return lambda values: tuple(map(convert, values))
    return None


def _constant(value: Any) -> Evaluate:
    if isinstance(value, int) and value.bit_length() > BITS_MAX:
        raise FilterError(f"an integer in a filter has at most {BITS_MAX} bits")
    return lambda message: value


# Operators and functions. Raise TypeError for values that never fit, and _UNDEFINED for values that are the message's.


def _bounded(value: Any) -> Any:
    if isinstance(value, int) and value.bit_length() > BITS_MAX:
        raise OverflowError(f"an integer of more than {BITS_MAX} bits")
    return value


def _numeric(symbol: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the operator for numbers only: for other values, it could repeat them, or format them at length."""

    def calculate(*values: Any) -> Any:
        if not all(isinstance(each, int | float) for each in values):
            raise TypeError(f"{symbol} takes numbers, not {' and '.join(map(_kind, values))}")
        return function(*values)

    return calculate


def _bitwise(symbol: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the operator for integers; for truth values there are and, or, not."""

    def calculate(*values: Any) -> Any:
        if not all(type(each) is int for each in values):
            raise TypeError(f"{symbol} takes integers; {_JOIN}")
        return function(*values)

    return calculate


def _power(base: float, exponent: float) -> Any:
    if isinstance(base, int) and isinstance(exponent, int) and abs(exponent) > BITS_MAX:
        raise OverflowError(f"an exponent of more than {BITS_MAX}")
    power = base**exponent
    if isinstance(power, complex):
        raise ValueError("root of a negative number")
    return power


def _shift_left(value: int, count: int) -> int:
    if not 0 <= count <= BITS_MAX:
        raise OverflowError(f"a shift that is not from 0 to {BITS_MAX}")
    return value << count


def _round(value: float, digits: int = 0) -> Any:
    if abs(digits) > _DIGITS_MAX:
        raise OverflowError(f"rounding to more than {_DIGITS_MAX} digits")
    return round(value, digits)


def _extreme(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return max or min; Python's own text for no values depends on its version."""

    @functools.wraps(function)
    def pick(*values: Any) -> Any:
        if len(values) == 1 and isinstance(values[0], Sized) and not len(values[0]):
            raise ValueError(f"{function.__name__}() of no values")
        return function(*values)

    return pick


def _kind(value: Any) -> str:
    if isinstance(value, int | float):
        return "a number"
    return "a text" if isinstance(value, str) else "a list" if isinstance(value, tuple | Array | bytes) else "a message"


def _alike(function: Callable[[Any, Any], bool]) -> Callable[[Any, Any], bool]:
    """Return the comparison for values of one kind: a number never equals a text, so that is an error."""

    def compare(left: Any, right: Any) -> bool:
        if _kind(left) != _kind(right):
            raise TypeError(f"{_kind(left)} can't be compared with {_kind(right)}")
        return function(left, right)

    return compare


def _is_in(left: Any, right: Any) -> bool:
    return bool(left in right)


FUNCTIONS: dict[str, Callable[..., Any]] = {
    "abs": abs,
    "hypot": math.hypot,
    "isnan": math.isnan,
    "len": len,
    "max": _extreme(max),
    "min": _extreme(min),
    "round": _round,
    "sqrt": math.sqrt,
    "sum": sum,
}
"""What an expression can call."""

_CONSTANTS = {"true": True, "false": False, "inf": math.inf}  # as JSON and YAML write them
_UNARY: dict[type[ast.unaryop], Callable[..., Any]] = {
    ast.Not: operator.not_,
    ast.UAdd: _numeric("+", operator.pos),
    ast.USub: _numeric("-", operator.neg),
    ast.Invert: _bitwise("~", operator.invert),
}
_BINARY: dict[type[ast.operator], Callable[..., Any]] = {
    ast.Add: _numeric("+", operator.add),
    ast.Sub: _numeric("-", operator.sub),
    ast.Mult: _numeric("*", operator.mul),
    ast.Div: _numeric("/", operator.truediv),
    ast.FloorDiv: _numeric("//", operator.floordiv),
    ast.Mod: _numeric("%", operator.mod),
    ast.Pow: _numeric("**", _power),
    ast.BitAnd: _bitwise("&", operator.and_),
    ast.BitOr: _bitwise("|", operator.or_),
    ast.BitXor: _bitwise("^", operator.xor),
    ast.LShift: _bitwise("<<", _shift_left),
    ast.RShift: _bitwise(">>", operator.rshift),
}
_BITWISE = {ast.BitAnd, ast.BitOr, ast.BitXor}
_COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Eq: _alike(operator.eq),
    ast.NotEq: _alike(operator.ne),
    ast.Lt: _alike(operator.lt),
    ast.LtE: _alike(operator.le),
    ast.Gt: _alike(operator.gt),
    ast.GtE: _alike(operator.ge),
    ast.In: _is_in,
    ast.NotIn: lambda left, right: not _is_in(left, right),
}
