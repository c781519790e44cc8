"""The emulated module against what was recorded from the firmware, and as the fake peer of a test."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.codecs import debug, management
from r2p.codecs.management import FLAG_BOOT, FLAG_REBOOTED, FLAG_STOPPED
from r2p.msg import Float32, Led, Text, Velocity3
from r2p.sim.modules import FirmwareModule, Publishes, Subscribes
from r2p.sim.modules.firmware import HEAP
from tests.vectors import FROM_NODE, TO_NODE, Case, cases

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

MS = 1_000_000
NEAR = 30  # ms; in two recordings the firmware is that much off its own beat

EXCEPTIONS = (
    "malformed_mgmt_leaks_pool-",  # deaf after 14 bad lines: a defect that is not emulated
    "subscribe_leds_queue0_asserts_off-",  # a build without the assertion that halts it
    "subscribe_leds_wrong_size-",  # two things at one instant, in the other order
    "reconnect-",  # what it says to nobody is recorded when somebody is there again
)
RECORDED = [case for case in cases("pubsub") if case.build.startswith("plain") and not str(case).startswith(EXCEPTIONS)]


def recorded_nodes(*, repeats: bool = True) -> FirmwareModule:
    """A module with the nodes of the recordings."""
    values = itertools.cycle((0, 1))
    return FirmwareModule(
        "IMU1",
        publishers=[Publishes("leds", Led, 0.5, lambda _time: Led(led=2, value=next(values)))],
        subscribers=[Subscribes("cmd", Velocity3, 5)],
        repeats=repeats,
    )


class Line:
    """The other end of the line, which advances the time."""

    def __init__(self, module: FirmwareModule, start: int = 0, *, boot_mode: bool = False) -> None:
        self.module = module
        self.now = start
        self.heard: list[tuple[int, Any]] = []  # ms, (topic, data) or a management message
        self._reader = debug.Reader()
        self._hear(start, module.power_on(start, boot_mode=boot_mode))

    def until(self, ms: float) -> None:
        """Let time pass."""
        end = round(ms * MS)
        while (deadline := self.module.next_deadline()) is not None and deadline <= end:
            self._hear(deadline, self.module.poll(deadline))
        self.now = end

    def send(self, data: bytes) -> None:
        self._hear(self.now, self.module.receive(self.now, data))

    def say(self, *messages: management.Management) -> None:
        for message in messages:
            self.send(debug.encode(b"R2P", management.encode(message), 0))

    def publish(self, topic: str, message: r2p.Message) -> None:
        self.send(debug.encode(topic.encode(), message.encode(), 0))

    def received(self) -> list[Any]:
        """What was heard since the last call."""
        heard, self.heard = self.heard, []
        return [what for _, what in heard]

    def _hear(self, at: int, data: bytes) -> None:
        self.heard += [(at // MS, gist(line)) for line in self._reader.feed(data)]
        assert not self._reader.drops


def gist(line: debug.Line) -> Any:
    """What a line says; its deadline, and the raw_params and queue of an announcement mean nothing."""
    if line.topic != b"R2P":
        return line.topic.decode(), line.data
    message = management.decode(line.data)
    if isinstance(message, management.Alive):
        return message
    assert isinstance(message, management.Advertise | management.SubscribeRequest | management.SubscribeResponse)
    return type(message).__name__, message.topic, message.size


def replayed(case: Case) -> Line:
    """The emulated module in the recorded one's place."""
    line = Line(recorded_nodes(repeats="noiter" not in case.build), case.transcript[0].t_ms * MS)
    for entry in case.transcript:
        if entry.dir == TO_NODE:
            line.until(entry.t_ms)
            line.send(entry.data)
    line.until(case.transcript[-1].t_ms + 5)
    return line


def recorded(case: Case) -> Iterator[tuple[int, Any]]:
    reader = debug.Reader()
    for entry in case.transcript:
        if entry.dir == FROM_NODE:
            yield from ((entry.t_ms, gist(line)) for line in reader.feed(entry.data))


@pytest.mark.golden
@pytest.mark.parametrize("case", RECORDED, ids=str)
def test_it_says_what_firmware_said(case: Case) -> None:
    """The same, in the same order, and at the same time."""
    ours, theirs = replayed(case).heard, list(recorded(case))
    assert [what for _, what in ours] == [what for _, what in theirs]
    assert max(abs(a - b) for (a, _), (b, _) in zip(ours, theirs, strict=True)) <= NEAR


def calls(case: Case) -> int:
    """Messages that the recorded node's subscriber got."""
    return sum("CALLBACK cmd" in line for line in case.node_log[""])


@pytest.mark.golden
@pytest.mark.parametrize("case", [case for case in RECORDED if calls(case) and "malformed" not in case.name], ids=str)
def test_it_receives_what_firmware_received(case: Case) -> None:
    """Except for wrong checksums, which firmware does not check."""
    module = replayed(case).module
    assert module.received["cmd"] == calls(case) - module.drops["checksum"]


@pytest.mark.golden
@pytest.mark.parametrize("case", RECORDED, ids=str)
def test_the_first_bytes_are_the_boot_marker(case: Case) -> None:
    """After power on, and after each REBOOT."""
    marker = b"\r\n\r\n@"
    assert case.stream().startswith(marker)
    assert recorded_nodes().power_on(0).startswith(marker)


def booted(module: FirmwareModule | None = None) -> Line:
    """A module whose nodes are up, and what it has sent so far discarded."""
    line = Line(module or recorded_nodes())
    line.until(500)
    line.received()
    return line


def alive(line: Line) -> list[int]:
    """The flags of the ALIVE messages since the last call."""
    return [what.flags for what in line.received() if isinstance(what, management.Alive)]


def test_flags_of_its_lives() -> None:
    line = Line(recorded_nodes())
    assert alive(line) == [0]
    line.say(management.Stop("IMU1"))
    line.until(4000)
    assert set(alive(line)) == {FLAG_STOPPED}
    for command, flags in ((management.Bootload, FLAG_REBOOTED | FLAG_BOOT), (management.Reboot, FLAG_REBOOTED)):
        line.say(command("IMU1"))
        line.until(line.now / MS + 10)
        assert alive(line) == [flags]
        assert line.module.flags == flags
    line.module.power_on(line.now, boot_mode=True)
    assert line.module.flags == FLAG_BOOT


@pytest.mark.parametrize("order", [management.Stop, management.Reboot, management.Bootload])
@pytest.mark.parametrize("name", ["IMU", "IMU1X", "imu1", "PC1"])
def test_orders_to_others_do_not_concern_it(order: type[management.Stop], name: str) -> None:
    line = booted()
    line.say(order(name))
    line.until(5000)
    assert set(alive(line)) == {0}


def test_it_is_deaf_while_it_restarts() -> None:
    line = booted()
    line.say(management.Reboot("IMU1"), management.SubscribeRequest("leds", 5, 1))
    line.until(509)
    assert line.received() == []


def test_nothing_flows_before_the_handshake() -> None:
    line = booted()
    line.publish("cmd", Velocity3(x=1.0))
    line.until(1200)
    assert line.module.sent == {}
    assert line.module.received == {}
    assert line.module.drops == {"not subscribed": 1}
    line.say(management.SubscribeResponse("cmd", 12), management.SubscribeRequest("leds", 5, 1))
    line.until(1250)
    line.publish("cmd", Velocity3(x=2.0))
    line.until(1600)
    assert line.module.last == {"cmd": Velocity3(x=2.0)}
    assert line.module.sent == {"leds": 1}


def test_after_stop_nothing_flows_any_more() -> None:
    line = booted()
    line.say(management.SubscribeResponse("cmd", 12), management.SubscribeRequest("leds", 5, 1))
    line.say(management.Stop("IMU1"))
    line.publish("cmd", Velocity3())
    line.say(management.SubscribeRequest("leds", 5, 1), management.Advertise("cmd", 12))
    line.received()
    line.until(9000)
    assert all(isinstance(what, management.Alive) for what in line.received()[2:])
    assert (line.module.sent, line.module.received) == ({}, {})


def test_a_restart_forgets_who_subscribed() -> None:
    line = booted()
    line.say(management.SubscribeResponse("cmd", 12), management.SubscribeRequest("leds", 5, 1))
    line.say(management.Reboot("IMU1"))
    line.until(2000)
    line.publish("cmd", Velocity3())
    assert (line.module.sent, line.module.received) == ({}, {})


def test_a_queue_of_nothing_halts_it_until_its_power_is_cut() -> None:
    line = booted()
    zero = bytearray(management.encode(management.SubscribeRequest("leds", 5, 1)))
    zero[18] = 0
    line.send(debug.encode(b"R2P", bytes(zero), 0))
    line.say(management.Reboot("IMU1"))
    line.until(9000)
    assert line.received() == []
    assert line.module.halted
    assert line.module.publish(line.now, "leds", Led()) == b""
    line.module.power_on(line.now)
    assert not line.module.halted


def test_a_topic_of_no_size_overruns_its_buffers() -> None:
    line = booted()
    line.say(management.SubscribeRequest("leds", 0, 5))
    line.until(9000)
    assert line.received() == []
    assert "size 0" in line.module.fault


def test_a_halted_module_sends_nothing_even_if_it_is_polled() -> None:
    line = booted()
    line.say(management.SubscribeRequest("leds", 5, 1), management.SubscribeRequest("leds", 0, 5))
    assert line.module.halted
    assert line.module.sent == {}
    for ms in range(500, 9000, 100):  # a step of repetition and a message of the publisher are due
        assert line.module.poll(ms * MS) == b""
    assert line.module.sent == {}
    assert line.module.next_deadline() is None


def test_queues_come_from_a_small_heap() -> None:
    module = FirmwareModule("IMU1", publishers=[Publishes("leds", Led), Publishes("text", Text)])
    line = booted(module)
    line.say(management.SubscribeRequest("leds", 5, 5), management.SubscribeRequest("leds", 5, 1024))
    assert module.heap_free == HEAP - 5 * (5 + 8), "a repeat takes no more"
    assert not module.fault
    line.say(management.SubscribeRequest("text", r2p.layout(Text).size, 1024))
    assert "NULL" in module.fault
    assert module.halted
    module.power_on(line.now)
    assert module.heap_free == HEAP
    assert not module.fault


def test_its_own_subscribers_take_of_the_heap() -> None:
    assert (
        booted(FirmwareModule("IMU1", subscribers=[Subscribes("cmd", Velocity3, 5)])).module.heap_free == HEAP - 5 * 20
    )


def test_a_stop_in_boot_mode_hangs_its_management() -> None:
    line = Line(recorded_nodes())
    line.say(management.Bootload("IMU1"))
    line.until(2000)
    line.received()
    line.say(management.Stop("IMU1"), management.Reboot("IMU1"))
    line.until(9000)
    assert line.received() == []
    assert "boot mode" in line.module.fault
    assert not line.module.halted
    line.module.power_on(line.now)
    line.until(line.now / MS + 2000)
    assert set(alive(line)) == {0}


def test_data_that_follow_a_response_too_soon_are_lost() -> None:
    line = booted()
    line.say(management.SubscribeResponse("cmd", 12))
    for ms in (500, 549, 550):
        line.until(ms)
        line.publish("cmd", Velocity3(x=float(ms)))
    assert line.module.drops == {"not subscribed": 2}
    assert line.module.last == {"cmd": Velocity3(x=550.0)}


def test_a_wrong_size_is_dropped_and_counted() -> None:
    line = booted()
    line.say(management.SubscribeResponse("cmd", 12))
    line.until(550)
    line.publish("cmd", Led())
    line.send(debug.encode(b"R2P", b"short", 0))
    assert line.module.drops == {"wrong size": 1, "undecodable": 1}


def test_bytes_may_come_one_by_one() -> None:
    line = booted()
    request = debug.encode(b"R2P", management.encode(management.SubscribeRequest("leds", 5, 1)), 0)
    for i in range(len(request)):
        line.send(request[i : i + 1])
    assert line.received() == [("SubscribeResponse", "leds", 5)]


def test_answers_are_published_at_once() -> None:
    def answer(command: Velocity3) -> Iterable[tuple[str, r2p.Message]]:
        return [("speed", Float32(command.x))]

    module = FirmwareModule(
        "MOTOR1",
        publishers=[Publishes("speed", Float32)],
        subscribers=[Subscribes("cmd", Velocity3, answer=answer), Subscribes("off", Led, answer=lambda _message: None)],
    )
    line = booted(module)
    line.say(*(management.SubscribeResponse(topic, 0) for topic in ("cmd", "off")))
    line.say(management.SubscribeRequest("speed", 4, 1))
    line.until(550)
    line.received()
    line.publish("cmd", Velocity3(x=2.0))
    line.publish("off", Led())
    assert line.received() == [("speed", Float32(2.0).encode())]
    assert module.sent == {"speed": 1}


def test_fill_may_skip_and_missed_periods_stay_missed() -> None:
    times: list[int] = []

    def fill(time: int) -> Led | None:
        times.append(time // MS)
        return None if len(times) == 2 else Led()

    line = booted(FirmwareModule("IMU1", publishers=[Publishes("leds", Led, 0.1, fill)], repeats=False))
    line.until(650)
    assert times == []  # nobody subscribes
    line.say(management.SubscribeRequest("leds", 5, 1))
    line.until(900)
    line.module.poll(1250 * MS)
    line.until(1300)
    assert times == [700, 800, 900, 1250, 1300]
    assert line.module.sent == {"leds": 4}


def test_what_it_can_not_publish() -> None:
    with pytest.raises(r2p.Error, match="IMU1 has no publisher of cmd"):
        recorded_nodes().publish(0, "cmd", Velocity3())
    with pytest.raises(r2p.NameTooLong):
        FirmwareModule("TOOLONGNAME")
    with pytest.raises(r2p.NameTooLong):
        FirmwareModule("IMU1", publishers=[Publishes("a_topic_with_a_long_name", Led)])
    with pytest.raises(r2p.MessageError):
        FirmwareModule("IMU1", subscribers=[Subscribes("cmd", r2p.Message)])
