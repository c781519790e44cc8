"""Hypothesis strategies for messages, made from their shapes: any value that a field holds, as it comes back."""

from typing import Any

from hypothesis import strategies as st

from r2p.messages import Array, Chars, FixedArray, Layout, Nested, Scalar, Shape, VariableArray, VariableText
from r2p.messages.layouts import M

FLOATS = {"f32": st.floats(width=32, allow_nan=False), "f64": st.floats(allow_nan=False)}


def messages(layout: Layout[M]) -> st.SearchStrategy[M]:
    return st.builds(layout.cls, **{field.name: values(field.shape) for field in layout.fields})


def values(shape: Shape) -> st.SearchStrategy[Any]:
    match shape:
        case FixedArray(_, count, "bytes"):
            return st.binary(min_size=count, max_size=count)
        case VariableArray(_, limit, "bytes"):
            return st.binary(max_size=limit)
        case FixedArray(item, count, container):
            many = st.just((0,) * count) if count > 100 else st.tuples(*[values(item)] * count)
            return many.map(Array) if container == "array" else many
        case VariableArray(item, limit, container):
            some = st.lists(values(item), max_size=min(limit, 5))
            return some.map(Array) if container == "array" else some.map(tuple)
        case VariableText(limit):
            return st.text(max_size=limit // 4)
        case Nested(layout):
            return messages(layout)
        case Chars(length):
            return st.text(st.characters(min_codepoint=1, max_codepoint=127), max_size=length)
        case Scalar("bool"):
            return st.booleans()
        case Scalar(kind):
            return FLOATS[kind] if kind in FLOATS else st.integers(*shape.limits)
