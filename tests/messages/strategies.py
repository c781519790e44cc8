"""Hypothesis strategies for messages, made from their shapes: any value that a field holds, as it comes back."""

from typing import Any

from hypothesis import strategies as st

from r2p.messages import Array, Chars, Layout, Nested, Scalar, Shape
from r2p.messages.layouts import M

FLOATS = {"f32": st.floats(width=32, allow_nan=False), "f64": st.floats(allow_nan=False)}


def messages(layout: Layout[M]) -> st.SearchStrategy[M]:
    return st.builds(layout.cls, **{field.name: values(field.shape) for field in layout.fields})


def values(shape: Shape) -> st.SearchStrategy[Any]:
    match shape:
        case Array(item, count):
            return st.tuples(*[values(item)] * count)
        case Nested(layout):
            return messages(layout)
        case Chars(length):
            return st.text(st.characters(min_codepoint=1, max_codepoint=127), max_size=length)
        case Scalar("bool"):
            return st.booleans()
        case Scalar(kind):
            return FLOATS[kind] if kind in FLOATS else st.integers(*shape.limits)
