"""The shell around an RTCAN engine, the same for every port: feed it, act, re-arm one timer.

    port  --frames, confirmations-->  engine  --orders-->  port
                                              --messages, news-->  owner

What an action brings about comes after the actions before it: a port may confirm from within `transmit`, and the owner
may publish from within `act`.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from r2p.codecs.rtcan import Frame, OtherFrame
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Action, Mailbox, Outcome, Transmit, Withdraw
from r2p.transports.can.port import CanPort
from r2p.transports.stats import RETRY_AFTER_ERROR


class DriverOwner(Protocol):
    """Who gets what the engine has to tell: a link, or a benchmark."""

    def act(self, action: Action) -> None:
        """A message or news: any action but `Transmit` and `Withdraw`."""

    def bus_up(self) -> None:
        """The engine has started: `Ready` will follow."""

    def bus_down(self, reason: str) -> None:
        """The engine has stopped; what it discards is told next."""

    def bus_waits(self, reason: str) -> None:
        """The port can't be used yet."""

    def bus_fault(self, kind: str) -> None:
        """Something went wrong on the bus."""

    def internal_error(self, error: Exception) -> None:
        """A frame or an action raised: counted, logged, and the next one follows."""


class EngineDriver:
    """An engine at work on a port, whose `PortUser` it is. `do` carries out what a call of the engine gives back."""

    def __init__(self, engine: Engine, port: CanPort, owner: DriverOwner) -> None:
        self.engine = engine
        self.now = port.now
        """The clock of the engine and of all its instants (ns)."""
        self._port = port
        self._orders: dict[type, Callable[[Any], object]] = {Transmit: port.transmit, Withdraw: port.withdraw}
        self._owner = owner
        self._alarm = port.alarm(self._poll)
        self._actions: deque[Action] = deque()
        self._acting = False
        self._drained: asyncio.Future[None] | None = None
        self.internal_error = owner.internal_error
        self._waiting: Callable[[], object] = lambda: engine.waiting

    def do(self, actions: Sequence[Action]) -> None:
        """Carry these out, and wait for the engine's next deadline."""
        if actions:
            self._actions.extend(actions)
            if self._acting:
                return
            self._act()
        self._alarm.set(self.engine.next_deadline())
        if self._drained is not None and not self._waiting() and not self._drained.done():
            self._drained.set_result(None)

    def refilter(self) -> None:
        """The engine needs other frames than before."""
        self._port.set_filters(self.engine.filters())

    async def drained(self, longest: float, waiting: Callable[[], object] | None = None) -> None:
        """Wait until all messages are on the bus, at most `longest` seconds; or until there is nothing `waiting`."""
        self._waiting = waiting or (lambda: self.engine.waiting)
        if self._waiting():
            self._drained = asyncio.get_running_loop().create_future()
            await asyncio.wait([self._drained], timeout=longest)

    def close(self) -> None:
        """Let nothing happen any more."""
        self.do(self.engine.stop(self.now()))
        self._alarm.close()

    # For the port (`PortUser`)

    def received(self, frame: Frame, stamp: int) -> None:
        try:
            self.do(self.engine.receive(self.now(), frame, stamp))
        except Exception as error:  # noqa: BLE001 - counted and logged; the next frame follows
            self._failed(error)

    def other(self, frame: OtherFrame, stamp: int) -> None:
        """Nothing that concerns RTCAN."""

    def confirmed(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        try:
            self.do(self.engine.confirm(self.now(), mailbox, outcome, at))
        except Exception as error:  # noqa: BLE001 - counted and logged; the next confirmation follows
            self._failed(error)

    def up(self) -> None:
        try:
            self.refilter()
            self.do(self.engine.start(self.now()))
            self._owner.bus_up()
        except Exception as error:  # noqa: BLE001 - counted and logged
            self._failed(error)

    def down(self, reason: str) -> None:
        try:
            actions = self.engine.stop(self.now())
            self._owner.bus_down(reason)
            self.do(actions)
        except Exception as error:  # noqa: BLE001 - counted and logged
            self._failed(error)

    def waits(self, reason: str) -> None:
        self._owner.bus_waits(reason)

    def fault(self, kind: str) -> None:
        self._owner.bus_fault(kind)

    # Inside

    def _poll(self) -> None:
        try:
            self.do(self.engine.poll(self.now()))
        except Exception as error:  # noqa: BLE001 - counted and logged
            self._failed(error)

    def _failed(self, error: Exception) -> None:
        """The engine raised: go on with it, but not at once where a deadline is over that it can't get past."""
        self.internal_error(error)
        deadline = self.engine.next_deadline()
        self._alarm.set(None if deadline is None else max(deadline, self.now() + RETRY_AFTER_ERROR))

    def _act(self) -> None:
        actions, orders, act = self._actions, self._orders, self._owner.act
        self._acting = True
        try:
            while actions:
                action = actions.popleft()
                try:
                    orders.get(type(action), act)(action)
                except Exception as error:  # noqa: BLE001 - counted and logged; the next action follows
                    self.internal_error(error)
        finally:
            self._acting = False
