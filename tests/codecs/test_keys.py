"""What proves a key, against vectors that OpenSSL computed, and against bytes that only resemble it."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import UnknownType, keys, management
from r2p.errors import DecodeError
from r2p.keys import SharedKey
from tests.vectors import GOLDEN

VECTORS: list[dict[str, Any]] = json.loads((GOLDEN / "keys.json").read_text())["vectors"]
KEY = SharedKey(bytes(32))


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["name"])
def test_messages_are_those_that_openssl_computed(vector: dict[str, Any]) -> None:
    key = SharedKey(bytes.fromhex(vector["key"]))
    challenge, proof, seal, call = (vector[name] for name in ("challenge", "proof", "seal", "seal_of_call"))
    session, nonce = challenge["session"], bytes.fromhex(challenge["nonce"])
    covered = (b"R2P", bytes.fromhex(seal["covers"]))
    made: list[management.Management] = [
        keys.Challenge(session, nonce),
        keys.prove(key, nonce, session, proof["counter"], proof["end"]),
        keys.seal(key, session, seal["counter"], seal["first"], covered),
        keys.seal(key, session, call["counter"], call["first"], (b"R2P_CALL", bytes.fromhex(call["covers"]))),
    ]
    for message, expected in zip(made, (challenge, proof, seal, call), strict=True):
        data = bytes.fromhex(expected["message"])
        assert management.encode(message) == data
        assert management.decode(data) == message
    assert key.id.to_bytes(2, "little").hex() == vector["id"]
    assert isinstance(made[1], keys.Proof)
    assert keys.is_proven(key, nonce, made[1])
    assert isinstance(made[2], keys.Seal)
    assert keys.is_sealed(key, made[2], covered)


@given(st.integers(0, 31), st.integers(1, 255))
def test_a_seal_with_another_bit_is_none(at: int, flip: int) -> None:
    covered = (b"R2P", management.encode(management.Stop("IMU1")))
    data = bytearray(management.encode(keys.seal(KEY, 7, 2, 1, covered)))
    data[at] ^= flip
    try:
        seal = management.decode(bytes(data))
    except (DecodeError, UnknownType):
        return
    assert not isinstance(seal, keys.Seal) or seal.key != KEY.id or not keys.is_sealed(KEY, seal, covered)


@given(st.binary(min_size=31, max_size=31), st.sampled_from([0x58, 0x59, 0x5A]))
def test_any_body_decodes_to_what_encodes_again_or_is_ignored(body: bytes, kind: int) -> None:
    try:
        message = management.decode(body + bytes((kind,)))
    except UnknownType:
        assert body[0] != 1
    else:
        assert management.decode(management.encode(message)) == message
