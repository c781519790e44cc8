"""Error frames, as drivers fill them."""

from __future__ import annotations

import pytest

from r2p.transports.can.errorframes import Report, decode


@pytest.mark.parametrize(
    ("identifier", "data", "expected"),
    [
        (0x001, "", Report(("transmit time-out",), destroyed=True)),
        (0x002, "05", Report(("arbitration lost",), lost=True)),
        (0x004, "00 03", Report(("receive overflow", "transmit overflow"))),
        (0x004, "00 28", Report(("error-warning (transmit)", "error-passive (transmit)"))),
        (0x004, "", Report(("controller",))),
        (0x008, "00 00 04", Report(("stuff error",))),
        (0x008, "00 00 81", Report(("bit error",), destroyed=True)),
        (0x008, "00 00 80", Report(("protocol error",), destroyed=True)),
        (0x010, "", Report(("transceiver",))),
        (0x028, "00 00 00 19", Report(("no acknowledge", "protocol error"), destroyed=True)),
        (0x040, "", Report(("bus-off",))),
        (0x080, "", Report(("bus error",))),
        (0x100, "", Report(("restarted",))),
        (0x200, "00 00 00 00 00 00 10 20", Report(("error 0x200",))),
        (0x044, "00 40", Report(("bus-off", "error-active"))),
    ],
)
def test_kinds(identifier: int, data: str, expected: Report) -> None:
    assert decode(identifier, bytes.fromhex(data).ljust(8, b"\0")) == expected


def test_bus_off_is_told() -> None:
    assert decode(0x44, bytes(8)).bus_off
    assert not decode(0x3F, bytes(8)).bus_off
