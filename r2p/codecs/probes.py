"""Probes, by which a gateway finds out whether messages return by another link, through gateways of firmware.

Those pass on every ALIVE, but nothing unknown to them. So a probe is the ALIVE of a module that can't exist: its
name begins with `_`, as those of tools, which send no ALIVE. Six digits to the base 62 hold the gateway and its port.
"""

import string

from r2p.codecs import management

_DIGITS = string.digits + string.ascii_letters
_LENGTH = 6
PORT_MODULUS = 13
"""A probe carries the number of its port modulo this: 62^6 / 2^32 values are left besides the gateway's 32 bits."""


def encode(gateway: int, port: int) -> bytes:
    """Return the probe of a port."""
    number = gateway * PORT_MODULUS + port % PORT_MODULUS
    name = ""
    for _ in range(_LENGTH):
        number, digit = divmod(number, len(_DIGITS))
        name = _DIGITS[digit] + name
    return management.encode(management.Alive(f"_{name}"))


def decode(data: bytes) -> tuple[int, int] | None:
    """Return gateway and port of a probe; None for any other ALIVE."""
    name = data[: _LENGTH + 1].decode("latin-1")
    if name[0] != "_" or not all(each in _DIGITS for each in name[1:]):
        return None
    number = 0
    for each in name[1:]:
        number = number * len(_DIGITS) + _DIGITS.index(each)
    gateway, port = divmod(number, PORT_MODULUS)
    return (gateway, port) if gateway <= 0xFFFFFFFF else None
