"""Answers to the question for a type by its fingerprint (PROTOCOL.md 10): the name of its class, and its schema.

Wheel
speed:f32 currents:f32[2]
"""

from hashlib import blake2b

from r2p.errors import DecodeError

LONGEST = 40_000
"""Bytes of an answer."""

FINGERPRINT = 8


def encode(name: str, schema: str) -> bytes:
    """The answer of a module that has the type."""
    return f"{name}\n{schema}".encode()


def decode(data: bytes, fingerprint: bytes) -> tuple[str, str]:
    """Name and schema. Raises DecodeError for an answer that lies: whose schema is not that of the fingerprint."""
    if len(data) > LONGEST or not data.isascii():
        raise DecodeError("no schema")
    name, _, schema = data.decode().partition("\n")
    if blake2b(schema.encode(), digest_size=FINGERPRINT).digest() != fingerprint:
        raise DecodeError(f"a schema that is not that of {fingerprint.hex()}")
    return name, schema
