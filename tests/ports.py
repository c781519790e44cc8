"""Ports for what has to be told one before anybody listens: a page's commands, a router that comes back where it was.

Whoever can listens at port 0 instead, and says where.
"""

import contextlib
import secrets
import socket


def free_port() -> int:
    """A port of loopback that is free now, for streams and for datagrams.

    It is none of those that the kernel may give somebody before it is used.
    """
    while True:
        address = "127.0.0.1", 20_000 + secrets.randbelow(10_000)
        with contextlib.suppress(OSError), socket.create_server(address), socket.socket(type=socket.SOCK_DGRAM) as udp:
            udp.bind(address)
            return address[1]
