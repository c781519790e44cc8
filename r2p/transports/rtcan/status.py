"""What an RTCAN link says to people: what the classes mean on it now, and what happens on the bus."""

from collections import deque
from collections.abc import Callable
from typing import Any

from r2p.codecs.attachment import ClockOffset
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import (
    Action,
    EngineSettings,
    IdConflict,
    LostSync,
    NewMaster,
    ParameterMismatch,
    ParametersMatch,
    Profile,
)
from r2p.runtime.sample import PublisherClass
from r2p.transports.can.port import CanPort
from r2p.transports.rtcan.slots import SlottedTopic

HOLDABLE = 500_000
"""Ns: a port that can't hit an instant exactly does not try to hold shorter slots."""

_SOFT = "soft real-time with the period as deadline"


class LinkStatus:
    """The truth about one link, in words."""

    def __init__(self, engine: Engine, port: CanPort, settings: EngineSettings) -> None:
        self._engine = engine
        self._port = port
        self._reserves = settings.reserves
        self._fixed = settings.id8 is not None

    @property
    def no_slots(self) -> str:
        """Why periodic messages never get slots here; empty: they may."""
        if not self._reserves:
            slot = self._engine.timing.slot // 1000
            return f"slots of {slot} us are too short for a port that does not hit them; choose slots= and cycle="
        if self._engine.profile is Profile.FIRMWARE:
            return "firmware of 2014 keeps no cycle"
        return ""

    def notice(self, news: Action) -> tuple[str, str, bool]:
        """What happened on the bus: its kind, a text, and whether it is trouble."""
        if isinstance(news, IdConflict):
            return _conflict(news, self._fixed)
        return _NOTICES[type(news)](news)

    def guarantee(self, publisher_class: PublisherClass, slotted: SlottedTopic | None) -> str:
        """What a class means for a topic, which may have slots."""
        engine = self._engine
        if engine.silenced is not None:
            return f"nothing is sent: {engine.silenced}"
        if not engine.ready:
            return "nothing yet: not on the bus"
        match publisher_class:
            case PublisherClass.PERIODIC:
                return self._periodic(slotted)
            case PublisherClass.SPORADIC:
                fresh = "fresh at each try" if self._port.one_shot else "fixed when a frame is handed to the controller"
                return f"soft real-time, least laxity first, {fresh}; late ones are signalled"
            case _:
                return "non real-time: what the others leave of the bus; waits for room"

    def _periodic(self, slotted: SlottedTopic | None) -> str:
        if self.no_slots:
            return f"best effort: {self.no_slots}; {_SOFT}"
        if slotted is None:
            return f"best effort: another publisher of the topic has the slots; {_SOFT}"
        if slotted.period and slotted.driven:
            return slotted.words(self._engine.timing)
        if slotted.elsewhere:
            return f"best effort: the slots of another link are its clock; {_SOFT}"
        master = "" if self._engine.master is not None else ": there is no master yet"
        return f"{slotted.words(self._engine.timing)}{master}; meanwhile {_SOFT}"


def _conflict(news: IdConflict, fixed: bool) -> tuple[str, str, bool]:
    then = "the other one should yield"
    if news.yielded:
        then = "it is the other's, this module " + ("waits till it is free" if fixed else "takes another one")
    return "id conflict", f"another node uses the id {news.id8} of this one: {then}", True


def _master(news: NewMaster) -> tuple[str, str, bool]:
    if news.own:
        return "master", f"this module is the RTCAN master (epoch {news.epoch:08x})", False
    who = "firmware" if news.id8 is None else f"node {news.id8}"
    return "master", f"{who} is the RTCAN master", False


_NOTICES: dict[type, Callable[[Any], tuple[str, str, bool]]] = {
    NewMaster: _master,
    LostSync: lambda news: ("no master", f"no RTCAN master: {news.reason}", True),
    ParameterMismatch: lambda news: ("other parameters", f"nothing is sent: {news.reason}", True),
    ParametersMatch: lambda _news: ("own parameters", "the network's parameters are ours after all", False),
}
"""News of the engine -> kind, text, whether it is trouble."""


# RTCAN's network time in UTC, as this computer sees both: the offset, and how far it was off lately.


_APART = 100_000_000  # ns between two measurements
_KEPT = 32


class UtcEstimator:
    """`network` and `utc` tell the two times (ns, None: not known), `epoch` which network time it is."""

    def __init__(
        self, network: Callable[[], int | None], utc: Callable[[], int], epoch: Callable[[], int | None]
    ) -> None:
        self._network = network
        self._utc = utc
        self._epoch = epoch
        self._measured: deque[int] = deque(maxlen=_KEPT)
        self._measured_at = -_APART
        self._clock: ClockOffset | None = None

    def clock(self, now: int) -> ClockOffset | None:
        """The translation at this instant (monotonic ns); None while there is no network time."""
        if now - self._measured_at >= _APART:
            self._measured_at = now
            self._measure()
        return self._clock

    def _measure(self) -> None:
        network, epoch = self._network(), self._epoch()
        if network is None or epoch is None:
            self._measured.clear()
            self._clock = None
            return
        if self._clock is not None and self._clock.epoch != epoch:
            self._measured.clear()
        self._measured.append(self._utc() - network)
        low, high = min(self._measured), max(self._measured)
        self._clock = ClockOffset(epoch, (low + high) // 2, max((high - low + 1) // 2, 1_000))
