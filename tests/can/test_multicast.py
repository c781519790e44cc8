"""python-can's CAN over UDP multicast, which shows a port its own frames without marking them."""

from __future__ import annotations

import subprocess

import pytest

from r2p.codecs.can_bits import Frame
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit
from r2p.transports.can.pythoncan import PythonCanPort
from tests.can.rig import using

pytestmark = [pytest.mark.can, pytest.mark.anyio]

GROUP = "239.74.163.2"
FRAME = Frame(10 << 23 | 0x0242 << 7, b"abc")


@pytest.fixture(scope="module", autouse=True)
def multicast() -> None:
    subprocess.run(("ip", "route", "replace", "239.0.0.0/8", "dev", "lo"), check=True)


async def test_two_ports() -> None:
    here, there = (PythonCanPort("udp_multicast", GROUP, 1_000_000) for _ in range(2))
    async with using(here) as us, using(there) as them:
        here.transmit(Transmit(FRAME, Mailbox.SRT, 0))
        await us.until(lambda: us.outcomes)
        await them.until(lambda: them.frames)
        there.transmit(Transmit(FRAME, Mailbox.NRT, 0))
        await them.until(lambda: them.outcomes)
        await us.until(lambda: us.frames)
        assert (us.frames, us.outcomes) == ([FRAME], [(Mailbox.SRT, Outcome.SENT)])
        assert (them.frames, them.outcomes) == ([FRAME], [(Mailbox.NRT, Outcome.SENT)])
