"""Leaves out of the API reference what an attribute is first set to, unless it is a default that readers can use.

mkdocstrings loads this extension (`mkdocs.yml`). Fields of classes keep their values if these are literals; code, and
what `__init__` begins with, would only be noise.
"""

import ast
from typing import Any

import griffe


class AttributeValues(griffe.Extension):
    """Drops values of attributes that are no literals of the class."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Called for each attribute."""
        if attr.value is not None and not ("class-attribute" in attr.labels and _is_literal(str(attr.value))):
            attr.value = None


def _is_literal(text: str) -> bool:
    try:
        ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return False
    return True
