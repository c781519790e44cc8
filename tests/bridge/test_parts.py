"""Small parts of a gateway by themselves."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from r2p.bridge.forwarding import DuplicateFilter
from r2p.codecs import management, probes
from r2p.runtime.sample import Sample, Source


@given(st.integers(0, 2**32 - 1), st.integers(0, 255))
def test_probes(gateway: int, port: int) -> None:
    assert probes.decode(probes.encode(gateway, port)) == (gateway, port % 13)


def test_what_is_no_probe() -> None:
    for name in ("IMU1", "_short", "_ab.def", "_ZZZZZZ"):
        assert probes.decode(management.encode(management.Alive(name))) is None


def sample(sequence: int, stamp: int, module: str = "A") -> Sample:
    return Sample(b"", Source(module, "n", "memory:a"), stamp, sequence=sequence)


def test_what_was_seen_before() -> None:
    seen = DuplicateFilter()
    assert not seen.again(sample(1, 100))
    assert seen.again(sample(1, 100))
    assert not seen.again(sample(1, 100, "B"))
    assert not seen.again(sample(1, 200))  # a publisher that started again
    for number in range(2, 500):
        assert not seen.again(sample(number, 100 * number))
    assert seen.again(sample(499, 49900))
