"""Probes: what a gateway says to find out whether it comes back by another link, through gateways of firmware.

Those pass on every ALIVE, and nothing that they don't know. So a probe is the ALIVE of a module that there can't be:
its name begins with `_`, as those of tools, which send no ALIVE; six digits to the base 62 tell the gateway and port.
"""

import string

from r2p.codecs import management

_DIGITS = string.digits + string.ascii_letters
_PORTS = 13  # as many as there is room for
_LENGTH = 6


def encode(gateway: int, port: int) -> bytes:
    """The probe of a port; its number is only known modulo 13."""
    number = gateway * _PORTS + port % _PORTS
    name = ""
    for _ in range(_LENGTH):
        number, digit = divmod(number, len(_DIGITS))
        name = _DIGITS[digit] + name
    return management.encode(management.Alive(f"_{name}"))


def decode(data: bytes) -> tuple[int, int] | None:
    """Gateway and port of a probe; None for any other ALIVE."""
    name = data[:7].decode("latin-1")
    if name[0] != "_" or not all(each in _DIGITS for each in name[1:]):
        return None
    number = 0
    for each in name[1:]:
        number = number * len(_DIGITS) + _DIGITS.index(each)
    gateway, port = divmod(number, _PORTS)
    return (gateway, port) if gateway <= 0xFFFFFFFF else None
