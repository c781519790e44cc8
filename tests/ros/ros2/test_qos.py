"""The QoS of tokens is written and read as other implementations do it, and differences are explained."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.ros.middleware import Qos
from r2p.ros.ros2.qos import decode_qos, encode_qos, lost_between
from tests.ros.ros2.recorded import has_own_liveliness, qos_of, recorded


def test_encode() -> None:
    for case in recorded()["qos_encode"]:
        if has_own_liveliness(case["qos"]):
            continue  # r2p's is always automatic: such a QoS is only read
        if case["qos"]["history"] == "KEEP_LAST" and case["qos"]["depth"] == 0:
            continue  # "keep the last 0" is no request that ROS has; here 0 keeps all
        assert encode_qos(qos_of(case["qos"])) == case["encoded"]


def test_decode() -> None:
    for case in recorded()["qos_decode"]:
        if "error" in case:
            with pytest.raises(r2p.DecodeError):
                decode_qos(case["encoded"])
        else:
            assert decode_qos(case["encoded"]) == qos_of(case["qos"]), case
    for case in recorded()["qos_encode"]:
        assert decode_qos(case["encoded"]) == qos_of(case["qos"]), case


times = st.integers(0, 9_223_372_035 * 10**9)


@given(st.builds(Qos, st.booleans(), st.booleans(), st.integers(0, 2**31), times, times))
def test_what_is_encoded_is_decoded(qos: Qos) -> None:
    assert decode_qos(encode_qos(qos)) == qos


@given(st.text() | st.from_regex(r"[0-9:,]{0,40}"))
def test_hostile(text: str) -> None:
    try:
        qos = decode_qos(text)
    except r2p.DecodeError:
        return
    assert 0 <= qos.depth <= 2**31
    assert decode_qos(encode_qos(qos)) == qos


LATCHED: Any = Qos(transient_local=True)


@pytest.mark.parametrize(
    ("publisher", "subscriber", "words"),
    [
        (Qos(), Qos(), []),
        (LATCHED, Qos(reliable=False), []),
        (Qos(), LATCHED, ["publisher is volatile", "transient local (latched)"]),
        (Qos(reliable=False), LATCHED, ["publisher is volatile", "publisher is best effort", "publisher reliable"]),
    ],
)
def test_differences(publisher: Qos, subscriber: Qos, words: list[str]) -> None:
    text = lost_between(publisher, subscriber)
    assert all(each in text for each in words)
    assert bool(text) == bool(words)
