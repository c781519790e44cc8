"""The loop that drives an engine, on a port that confirms at once."""

import asyncio
import operator
from collections.abc import Callable

import pytest

from r2p.clock import Alarm
from r2p.codecs import management, rtcan
from r2p.codecs.management import Alive
from r2p.codecs.rtcan import Frame
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit, Withdraw
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Action, Done, EngineSettings, Fate, Profile, Ready
from r2p.runtime.sample import PublisherClass
from r2p.transports.can.port import CanPort, PortAlarm
from r2p.transports.rtcan.driver import EngineDriver
from r2p.transports.rtcan.link import describe_guarantee, no_slots
from r2p.transports.rtcan.transport import RtcanOptions
from tests.faults import once

pytestmark = pytest.mark.virtual_time


class Port(CanPort):
    """Sends every frame within `transmit`, unless it is `stuck`."""

    def __init__(self) -> None:
        super().__init__("port")
        self.sent: list[Frame] = []
        self.filters: list[tuple[int, int]] | None = []
        self.stuck = False
        self.driver: EngineDriver

    async def run(self, listener: object, opened: Callable[[], object]) -> None:
        raise NotImplementedError

    def transmit(self, order: Transmit) -> None:
        self.sent.append(order.frame)
        if not self.stuck:
            self.driver.on_confirmed(order.mailbox, Outcome.SENT, self.now())

    def withdraw(self, order: Withdraw) -> None:
        self.driver.on_confirmed(order.mailbox, Outcome.LATE, self.now())

    def set_filters(self, filters: list[tuple[int, int]] | None) -> None:
        self.filters = filters

    def alarm(self, callback: Callable[[], object]) -> PortAlarm:
        return Alarm(asyncio.get_running_loop(), callback)


class Owner:
    """Records what the driver calls, and publishes once when the node is ready."""

    def __init__(self) -> None:
        self.actions: list[Action] = []
        self.changes: list[str] = []
        self.on_ready: Callable[[], object] = lambda: None

    def act(self, action: Action) -> None:
        self.actions.append(action)
        if isinstance(action, Ready):
            self.on_ready()

    def bus_up(self) -> None:
        self.changes.append("up")

    def bus_down(self, reason: str) -> None:
        self.changes.append(reason)

    def bus_waits(self, reason: str) -> None:
        self.changes.append(f"waits: {reason}")

    def bus_fault(self, kind: str) -> None:
        self.changes.append(f"fault: {kind}")

    def internal_error(self, error: Exception) -> None:
        self.changes.append(f"internal error: {error}")

    def fates(self) -> list[Fate]:
        return [each.fate for each in self.actions if isinstance(each, Done)]


def make() -> tuple[EngineDriver, Port, Owner]:
    port, owner = Port(), Owner()
    port.driver = driver = EngineDriver(Engine(EngineSettings(number=5, id8=9)), port, owner)
    return driver, port, owner


async def test_it_polls_when_the_engine_wants() -> None:
    driver, port, owner = make()
    driver.on_up()
    assert port.filters == [(0, 0)]
    await asyncio.sleep(2.0)
    assert owner.changes == ["up"]
    assert any(isinstance(each, Ready) for each in owner.actions)
    assert len(port.sent) == 2  # two claims
    driver.close()
    sent = len(port.sent)
    await asyncio.sleep(10.0)
    assert len(port.sent) == sent


async def test_a_port_that_confirms_at_once_and_an_owner_that_publishes_at_once() -> None:
    """What they bring about waits for its turn: a message of many frames goes out whole, and in order."""
    driver, port, owner = make()
    payload = bytes(range(100))
    owner.on_ready = lambda: driver.carry_out(driver.engine.publish(port.now(), 0x42, payload, handle="bulk"))
    driver.on_up()
    await asyncio.sleep(3.0)
    data = [frame for frame in port.sent if rtcan.high_byte(rtcan.decode_identifier(frame.id).message_id) == 0x42]
    assert b"".join(frame.data for frame in data) == payload
    assert [rtcan.decode_identifier(frame.id).left for frame in data] == list(range(12, -1, -1))
    assert owner.fates() == [Fate.SENT]


async def test_drained_when_all_is_on_the_bus_or_it_takes_too_long() -> None:
    driver, port, _ = make()
    driver.on_up()
    await asyncio.sleep(3.0)
    await driver.drain(1.0)
    port.stuck = True
    driver.carry_out(driver.engine.manage(port.now(), management.encode(Alive("A"))))
    before = port.now()
    await driver.drain(0.5)
    assert port.now() - before == 500_000_000
    waiting = asyncio.create_task(driver.drain(0.5))
    await asyncio.sleep(0.1)
    port.stuck = False
    driver.on_confirmed(Mailbox.SRT, Outcome.SENT, port.now())
    await waiting
    assert port.now() - before < 700_000_000


async def test_what_is_discarded_follows_the_bus_being_down() -> None:
    driver, port, owner = make()
    driver.on_up()
    await asyncio.sleep(3.0)
    port.stuck = True
    driver.carry_out(driver.engine.publish(port.now(), 0x42, b"x", handle="x"))
    owner.actions.clear()
    driver.on_down("cable cut")
    assert owner.changes == ["up", "cable cut"]
    assert owner.fates() == [Fate.DISCARDED]
    driver.on_waiting("no cable")
    driver.on_fault("stuff error")
    assert owner.changes[2:] == ["waits: no cable", "fault: stuff error"]


async def test_a_port_that_is_not_exact_asks_for_slots_only_where_they_are_coarse() -> None:
    port = Port()
    port.coarse = True
    for options, reserves in (
        (RtcanOptions(), False),
        (RtcanOptions(slots=10), True),
        (RtcanOptions(slots=20, cycle=0.010), True),
    ):
        settings = options.settings(1, port)
        assert settings.reserves == reserves
        assert bool(no_slots(Engine(settings))) is not reserves
    port.coarse = False
    assert RtcanOptions().settings(1, port).reserves


async def test_what_a_class_means_depends_on_the_controller() -> None:
    driver, port, _ = make()
    assert describe_guarantee(driver, PublisherClass.SPORADIC, None) == "nothing yet: not on the bus"
    driver.on_up()
    await asyncio.sleep(3.0)
    assert "fixed when a frame is handed to the controller" in describe_guarantee(driver, PublisherClass.SPORADIC, None)
    port.one_shot = True
    assert "fresh at each try" in describe_guarantee(driver, PublisherClass.SPORADIC, None)


@pytest.mark.parametrize("call", ["poll", "receive", "transmitter.mailboxes.confirm"])
async def test_an_engine_that_raises_goes_on(call: str, monkeypatch: pytest.MonkeyPatch) -> None:
    driver, port, owner = make()
    place, _, name = f"engine.{call}".rpartition(".")
    part = operator.attrgetter(place)(driver)
    monkeypatch.setattr(part, name, once(getattr(part, name)))
    driver.on_up()
    driver.on_frame(Frame(0, b""), 0)
    await asyncio.sleep(3.0)
    assert [each for each in owner.changes if each != "up"] == ["internal error: injected"]
    assert any(isinstance(each, Ready) for each in owner.actions)
    driver.carry_out(driver.engine.publish(port.now(), 0x42, b"x", handle="x"))
    await asyncio.sleep(1.0)
    assert owner.fates() == [Fate.SENT]


async def test_an_engine_that_always_raises_does_not_take_all_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    driver, _, owner = make()
    monkeypatch.setattr(driver.engine, "poll", lambda _now: 1 // 0)
    driver.on_up()
    await asyncio.sleep(5.0)
    assert 10 < len(owner.changes) < 60


async def test_an_action_that_raises_does_not_stop_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    driver, _, owner = make()
    monkeypatch.setattr(owner, "act", once(owner.act))
    actions = [Ready(9, Profile.RTCAN), Ready(10, Profile.RTCAN)]
    driver.carry_out(actions)
    assert owner.actions == actions[1:]
    assert owner.changes == ["internal error: injected"]
