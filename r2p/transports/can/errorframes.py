"""Error frames of SocketCAN: what a driver reports of the bus and of the controller (linux/can/error.h).

Not every driver reports everything: many tell of arbitration lost never, or only with `berr-reporting on`.
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
_TRANSMITTING = 0x80  # of the protocol errors: it was a frame of ours


class Report(msgspec.Struct, frozen=True):
    """What an error frame says: its kinds, and whether a frame that was being transmitted lost, or was destroyed."""

    kinds: tuple[str, ...]
    lost: bool = False
    destroyed: bool = False

    @property
    def bus_off(self) -> bool:
        return BUS_OFF in self.kinds


def decode(identifier: int, data: bytes) -> Report:
    """An error frame's identifier, without its flags, and its 8 bytes."""
    kinds = _names(identifier, _CLASSES)
    if identifier & _CONTROLLER:
        kinds += _names(data[1], _CONTROLLERS) or ["controller"]
    if identifier & _PROTOCOL:
        kinds += _names(data[2], _PROTOCOLS) or ["protocol error"]
    mine = bool(identifier & _PROTOCOL and data[2] & _TRANSMITTING)
    return Report(
        tuple(kinds) or (f"error {identifier:#x}",),
        lost=bool(identifier & _LOST_ARBITRATION),
        destroyed=mine or NO_ACKNOWLEDGE in kinds or TRANSMIT_TIMEOUT in kinds,
    )


def _names(bits: int, names: dict[int, str]) -> list[str]:
    return [name for bit, name in names.items() if bits & bit]
