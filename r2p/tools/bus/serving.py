"""`r2p bus serve`: a simulated CAN bus for other programs."""

import asyncio
import importlib.util
from typing import Annotated

import typer

from r2p.codecs.can_bits import FRAME_MAX, INTERMISSION, frame_bits_max
from r2p.errors import TransportError
from r2p.tools.config import UsageError
from r2p.tools.output import notify, program

SERVED = "rtcan:r2psim:"
"""How the URLs of buses begin that programs serve."""

_BITRATE = 1_000_000
_CYCLE = 10_000  # us: of URLs that say nothing of it
_SLOTS_MIN = 2  # in a cycle


async def serve(
    name: Annotated[str, typer.Argument(metavar="NAME", help="What other programs call it, such as lab.")],
    *,
    bitrate: Annotated[
        int, typer.Option("--bitrate", min=10_000, max=1_000_000, metavar="BIT/S", help="Bit rate of the bus.")
    ] = _BITRATE,
    noise: Annotated[
        float, typer.Option("--noise", min=0.0, max=1.0, metavar="SHARE", help="Share of frames with a bit error.")
    ] = 0.0,
    seed: Annotated[int | None, typer.Option("--seed", metavar="N", help="Seed of its random numbers.")] = None,
) -> None:
    """Run a simulated CAN bus for other programs.

    It is exact to the bit: arbitration, stuff bits, error frames, bus-off. Programs of this user join by python-can's
    interface r2psim, each as a node of its own. It runs until Ctrl-C.
    """
    from r2p.sim.buses.server import serve_bus  # takes long, and the other commands of this group need none of it
    from r2p.sim.transport import SimCan

    try:
        can = SimCan(bitrate=bitrate, noise=noise, seed=seed)
    except ValueError as error:
        raise UsageError(f"{error}: take 500000, 250000 or 125000") from error
    async with serve_bus(can, checked(name)):
        notify(
            f"the CAN bus {name} runs, with {bitrate} bit/s. In other terminals:\n" + "\n".join(hints(name, bitrate))
        )
        await asyncio.get_running_loop().create_future()


def checked(name: str) -> str:
    """Return the name of a bus that is to be served. Raises UsageError for one that can't be."""
    from r2p.sim.buses.rendezvous import check_name

    try:
        return check_name(name)
    except TransportError as error:
        raise UsageError(str(error)) from error


def hints(name: str, bitrate: int = _BITRATE) -> list[str]:
    """Return what to type in other terminals to look at a bus that is served."""
    url = SERVED + name + ("" if bitrate == _BITRATE else _options(bitrate))
    found = [f"{program()} bus dump --via {url}", f"{program()} bus load --via {url}"]
    if importlib.util.find_spec("can"):
        found += [f"python -m can.logger -i r2psim -c {name}"]
    return [f"  {each}" for each in found]


def _options(bitrate: int) -> str:
    """Return the options of a URL for a bit rate: its slots have room for the longest frame."""
    longest = -(-(frame_bits_max(FRAME_MAX) + INTERMISSION) * 1_000_000 // bitrate)  # us
    fitting = _CYCLE // longest
    return f",bitrate={bitrate}," + (f"slots={fitting}" if fitting >= _SLOTS_MIN else f"slots={_SLOTS_MIN},cycle=100ms")
