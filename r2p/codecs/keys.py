"""The management messages by which modules prove a shared key, and what their tags cover (PROTOCOL.md 9).

A tag is the first 16 bytes of an HMAC-SHA256 with the key, over a text that says what the tag is for and the fields
behind it. So no tag of one kind can pass for one of another kind.
"""

import struct

import msgspec

from r2p.keys import SharedKey

ANY_SESSION = 0
"""Challenge.session: any module at the other end of the line."""
NONCE = 16
"""Bytes of Challenge.nonce."""
COUNTER_MAX = 0xFFFFFFFF
"""The last counter of a session."""

_PROOF_INPUT = struct.Struct("<9s 16s I I B")
_SEAL_INPUT = struct.Struct("<8s I I I B")


class Challenge(msgspec.Struct, frozen=True, gc=False):
    """Ask the sender of seals with this `session` to prove that it has the key now. `nonce`: 16 random bytes."""

    session: int
    nonce: bytes


class Proof(msgspec.Struct, frozen=True, gc=False):
    """Answer a CHALLENGE: `counter` is the last one that the session has used, `end` the sender's end of the link."""

    session: int
    counter: int
    end: int
    tag: bytes


class Seal(msgspec.Struct, frozen=True, gc=False):
    """Precede a message of a holder of the key: the tag covers that message. `key` is the key's id.

    `first` is the counter under which the message was sent first: smaller than `counter` if it is sent again.
    """

    session: int
    counter: int
    first: int
    key: int
    tag: bytes


def prove(key: SharedKey, nonce: bytes, session: int, counter: int, end: int) -> Proof:
    """Return the answer to a challenge with this nonce."""
    return Proof(session, counter, end, key.tag(_proof_input(nonce, session, counter, end)))


def is_proven(key: SharedKey, nonce: bytes, proof: Proof) -> bool:
    """Return whether a PROOF answers a challenge with this nonce."""
    return key.made(proof.tag, _proof_input(nonce, proof.session, proof.counter, proof.end))


def seal(key: SharedKey, session: int, counter: int, first: int, message: tuple[bytes, bytes]) -> Seal:
    """Return the seal of a message: its topic and its bytes."""
    return Seal(session, counter, first, key.id, key.tag(_seal_input(session, counter, first, message)))


def is_sealed(key: SharedKey, seal: Seal, message: tuple[bytes, bytes]) -> bool:
    """Return whether a seal is that of this message: its topic and its bytes."""
    return key.made(seal.tag, _seal_input(seal.session, seal.counter, seal.first, message))


def _proof_input(nonce: bytes, session: int, counter: int, end: int) -> bytes:
    return _PROOF_INPUT.pack(b"r2p proof", nonce, session, counter, end)


def _seal_input(session: int, counter: int, first: int, message: tuple[bytes, bytes]) -> bytes:
    topic, data = message
    return _SEAL_INPUT.pack(b"r2p seal", session, counter, first, len(topic)) + topic + data
