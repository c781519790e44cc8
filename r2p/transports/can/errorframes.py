"""Error frames of SocketCAN: what a driver reports of the bus and of the controller (linux/can/error.h).

Not every driver reports everything: many never report that arbitration was lost, or only with `berr-reporting on`.
"""

import msgspec

ARBITRATION = "arbitration lost"
NO_ACKNOWLEDGE = "no acknowledge"
TRANSMIT_TIMEOUT = "transmit time-out"
BUS_OFF = "bus-off"
RESTARTED = "restarted"

_LOST_ARBITRATION, _CONTROLLER, _PROTOCOL, _TRANSCEIVER, _BUS_OFF = 0x2, 0x4, 0x8, 0x10, 0x40
_CLASSES = {
    0x1: TRANSMIT_TIMEOUT,
    _LOST_ARBITRATION: ARBITRATION,
    _TRANSCEIVER: "transceiver",
    0x20: NO_ACKNOWLEDGE,
    _BUS_OFF: BUS_OFF,
    0x80: "bus error",
    0x100: RESTARTED,
}
_CONTROLLERS = {
    0x01: "receive overflow",
    0x02: "transmit overflow",
    0x04: "error-warning (receive)",
    0x08: "error-warning (transmit)",
    0x10: "error-passive (receive)",
    0x20: "error-passive (transmit)",
    0x40: "error-active",
}
_PROTOCOLS = {
    0x01: "bit error",
    0x02: "form error",
    0x04: "stuff error",
    0x08: "dominant bit error",
    0x10: "recessive bit error",
    0x20: "overload",
    0x40: "active error",
}
_TRANSMITTING = 0x80  # bit of the protocol errors: this node was sending the frame


class ErrorReport(msgspec.Struct, frozen=True):
    """The kinds of errors that a frame reports, and whether a frame of this node lost arbitration or was destroyed."""

    kinds: tuple[str, ...]
    arbitration_lost: bool = False
    destroyed: bool = False

    @property
    def bus_off(self) -> bool:
        return BUS_OFF in self.kinds


def decode(identifier: int, data: bytes) -> ErrorReport:
    """Decode an error frame: its identifier, without the flags, and its 8 bytes."""
    kinds = _names(identifier, _CLASSES)
    if identifier & _CONTROLLER:
        kinds += _names(data[1], _CONTROLLERS) or ["controller"]
    if identifier & _PROTOCOL:
        kinds += _names(data[2], _PROTOCOLS) or ["protocol error"]
    own = bool(identifier & _PROTOCOL and data[2] & _TRANSMITTING)
    return ErrorReport(
        tuple(kinds) or (f"error {identifier:#x}",),
        arbitration_lost=bool(identifier & _LOST_ARBITRATION),
        destroyed=own or NO_ACKNOWLEDGE in kinds or TRANSMIT_TIMEOUT in kinds,
    )


def _names(bits: int, names: dict[int, str]) -> list[str]:
    return [name for bit, name in names.items() if bits & bit]
