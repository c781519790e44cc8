"""Error frames, as drivers fill them."""

from __future__ import annotations

import pytest

from r2p.transports.can.rawsocket import ErrorReport, decode_error


@pytest.mark.parametrize(
    ("identifier", "data", "expected"),
    [
        (0x001, "", ErrorReport(("transmit time-out",), destroyed=True)),
        (0x002, "05", ErrorReport(("arbitration lost",), arbitration_lost=True)),
        (0x004, "00 03", ErrorReport(("receive overflow", "transmit overflow"))),
        (0x004, "00 28", ErrorReport(("error-warning (transmit)", "error-passive (transmit)"))),
        (0x004, "", ErrorReport(("controller",))),
        (0x008, "00 00 04", ErrorReport(("stuff error",))),
        (0x008, "00 00 81", ErrorReport(("bit error",), destroyed=True)),
        (0x008, "00 00 80", ErrorReport(("protocol error",), destroyed=True)),
        (0x010, "", ErrorReport(("transceiver",))),
        (0x028, "00 00 00 19", ErrorReport(("no acknowledge", "protocol error"), destroyed=True)),
        (0x040, "", ErrorReport(("bus-off",))),
        (0x080, "", ErrorReport(("bus error",))),
        (0x100, "", ErrorReport(("restarted",))),
        (0x200, "00 00 00 00 00 00 10 20", ErrorReport(("error 0x200",))),
        (0x044, "00 40", ErrorReport(("bus-off", "error-active"))),
    ],
)
def test_kinds(identifier: int, data: str, expected: ErrorReport) -> None:
    assert decode_error(identifier, bytes.fromhex(data).ljust(8, b"\0")) == expected


def test_bus_off_is_reported() -> None:
    assert decode_error(0x44, bytes(8)).bus_off
    assert not decode_error(0x3F, bytes(8)).bus_off
