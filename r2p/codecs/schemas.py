"""Answers to a query for a type by its fingerprint (PROTOCOL.md 10): the name of its class, then its schema.

Wheel
speed:f32 currents:f32[2]
"""

from r2p.errors import DecodeError
from r2p.messages.layouts import fingerprint_of

ANSWER_MAX = 40_000
"""Bytes of the longest answer that is read."""


def encode(name: str, schema: str) -> bytes:
    """Encode the answer of a module that has the type."""
    return f"{name}\n{schema}".encode()


def decode(data: bytes, fingerprint: bytes) -> tuple[str, str]:
    """Decode name and schema. Raises DecodeError for a schema that does not have this fingerprint."""
    if len(data) > ANSWER_MAX or not data.isascii():
        raise DecodeError("not a schema")
    name, _, schema = data.decode().partition("\n")
    if fingerprint_of(schema) != fingerprint:
        raise DecodeError(f"a schema without the fingerprint {fingerprint.hex()}")
    return name, schema
