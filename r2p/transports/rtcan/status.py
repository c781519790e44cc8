"""What users read about an RTCAN link: what its publisher classes guarantee, and notices of events on the bus.

`UtcEstimator` belongs here too: it says how the network's time translates to UTC, and how well.
"""

from collections import deque
from collections.abc import Callable
from typing import Any

from r2p.clock import Clock
from r2p.messages import ClockOffset
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
from r2p.transports.rtcan.driver import EngineDriver
from r2p.transports.rtcan.slots import SlottedTopic

_SOFT = "soft real-time with the period as deadline"

_MEASURE_INTERVAL = 100_000_000  # ns between two measurements of UTC
_MEASUREMENTS = 32  # that count: those of the last 3 s
_UTC_ERROR_MIN = 1_000  # ns


class LinkStatus:
    """What is true of one link now, as texts."""

    def __init__(self, driver: EngineDriver, settings: EngineSettings) -> None:
        self._engine = driver.engine
        self._port = driver.port
        self._reserves = settings.reserves
        self._fixed_id = settings.id8 is not None

    @property
    def no_slots(self) -> str:
        """Why periodic messages never get slots here. Empty: they may."""
        if not self._reserves:
            slot = self._engine.timing.slot // 1000
            return f"slots of {slot} us are too short for a port that does not hit them; choose slots= and cycle="
        if self._engine.profile is Profile.FIRMWARE:
            return "firmware of 2014 keeps no cycle"
        return ""

    def notice(self, event: Action) -> tuple[str, str, bool]:
        """Describe an event on the bus: its kind, a text, and whether it is trouble."""
        if isinstance(event, IdConflict):
            return _conflict(event, fixed=self._fixed_id)
        return _NOTICES[type(event)](event)

    def guarantee(self, publisher_class: PublisherClass, slotted: SlottedTopic | None) -> str:
        """What a publisher class means for a topic; `slotted` if the topic is periodic and may have slots."""
        engine = self._engine
        if engine.network.mismatch is not None:
            return f"nothing is sent: {engine.network.mismatch}"
        if not engine.ready:
            return "nothing yet: not on the bus"
        match publisher_class:
            case PublisherClass.PERIODIC:
                return self._periodic(slotted)
            case PublisherClass.SPORADIC:
                laxity = (
                    "fresh at each try" if self._port.one_shot else "fixed when a frame is handed to the controller"
                )
                return f"soft real-time, least laxity first, {laxity}; late ones are signalled"
            case _:
                return "non real-time: what the others leave of the bus; waits for room"

    def _periodic(self, slotted: SlottedTopic | None) -> str:
        if self.no_slots:
            return f"best effort: {self.no_slots}; {_SOFT}"
        if slotted is None:
            return f"best effort: another publisher of the topic has the slots; {_SOFT}"
        if slotted.period and slotted.is_clock:
            return slotted.describe()
        if slotted.clock_elsewhere:
            return f"best effort: the slots of another link are its clock; {_SOFT}"
        master = "" if self._engine.network.master is not None else ": there is no master yet"
        return f"{slotted.describe()}{master}; meanwhile {_SOFT}"


def _conflict(event: IdConflict, *, fixed: bool) -> tuple[str, str, bool]:
    then = "the other one should yield"
    if event.yielded:
        then = "the other node keeps it, this module " + ("waits until it is free" if fixed else "takes another one")
    return "id conflict", f"another node uses the id {event.id8} of this one: {then}", True


def _master(event: NewMaster) -> tuple[str, str, bool]:
    if event.own:
        return "master", f"this module is the RTCAN master (epoch {event.epoch:08x})", False
    master = "firmware" if event.id8 is None else f"node {event.id8}"
    return "master", f"{master} is the RTCAN master", False


_NOTICES: dict[type, Callable[[Any], tuple[str, str, bool]]] = {
    NewMaster: _master,
    LostSync: lambda event: ("no master", f"no RTCAN master: {event.reason}", True),
    ParameterMismatch: lambda event: ("other parameters", f"nothing is sent: {event.reason}", True),
    ParametersMatch: lambda _event: (
        "own parameters",
        "the network's parameters are those of this module again",
        False,
    ),
}
"""Event of the engine -> kind, text, whether it is trouble."""


class UtcEstimator:
    """Estimates the offset of UTC, by the module's `clock`, from the network's time.

    Each measurement is off by an unknown delay, so the estimate is the middle of the last ones, and their spread is how
    far it may be off.
    """

    def __init__(self, driver: EngineDriver, clock: Clock) -> None:
        self._driver = driver
        self._clock = clock
        self._measured: deque[int] = deque(maxlen=_MEASUREMENTS)
        self._measured_at = -_MEASURE_INTERVAL
        self._offset: ClockOffset | None = None

    def offset(self, now: int) -> ClockOffset | None:
        """The estimate at this instant (monotonic ns). None while there is no network time."""
        if now - self._measured_at >= _MEASURE_INTERVAL:
            self._measured_at = now
            self._measure()
        return self._offset

    def _measure(self) -> None:
        engine = self._driver.engine
        network_time, epoch = engine.network_time(self._driver.now()), engine.network.epoch
        if network_time is None or epoch is None:
            self._measured.clear()
            self._offset = None
            return
        if self._offset is not None and self._offset.epoch != epoch:
            self._measured.clear()  # another run of the network: its time starts anew
        self._measured.append(self._clock.now() - network_time)
        low, high = min(self._measured), max(self._measured)
        self._offset = ClockOffset(epoch, (low + high) // 2, max((high - low + 1) // 2, _UTC_ERROR_MIN))
