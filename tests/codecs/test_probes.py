"""Probes, and what is not one."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import management, probes


@given(st.integers(0, 2**32 - 1), st.integers(0, 255))
def test_probes(gateway: int, port: int) -> None:
    assert probes.decode(probes.encode(gateway, port)) == (gateway, port % probes.PORT_MODULUS)


def test_other_names_are_not_probes() -> None:
    for name in ("IMU1", "_short", "_ab.def", "_ZZZZZZ"):
        assert probes.decode(management.encode(management.Alive(name))) is None
