"""`r2p doctor`, on machines that are made up."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p import keys
from r2p.codecs import management
from r2p.codecs.management import WIRE_VERSION
from r2p.msg import Led
from r2p.sim.modules import FirmwareModule, Powered, Publishes
from r2p.tools import doctor
from r2p.tools.checks import Check
from r2p.tools.output import Output
from r2p.tools.session import Session, Settings, join
from r2p.transports.can.netlink import Interface
from r2p.transports.tcp import TcpListenTransport
from r2p.transports.url import parse
from tests.ports import free_port
from tests.tools.rig import printed, process, robot, tool
from tests.transports.conversation import Script

if TYPE_CHECKING:
    from collections.abc import Iterable

RETRIES = "in one-shot mode, if the driver supports it, the laxity is updated before each attempt"

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="looks into Linux's files")


def write(root: Path, path: str, text: str = "") -> Path:
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="ascii")
    return file


def interface(root: Path, name: str, *, kind: int = 280, up: bool, virtual: bool = False) -> None:
    """A network interface as the kernel shows it; the kind 280 is CAN."""
    real = f"sys/devices/{'virtual' if virtual else 'pci0'}/net/{name}"
    write(root, f"{real}/type", f"{kind}\n")
    write(root, f"{real}/flags", "0x1003\n" if up else "0x1002\n")
    (root / "sys/class/net").mkdir(parents=True, exist_ok=True)
    (root / "sys/class/net" / name).symlink_to(root / real)


def findings(checks: Iterable[Check]) -> list[tuple[bool, str, str]]:
    return [(check.ok, check.found, check.do) for check in checks]


def test_can_interfaces_that_are_down_get_their_command(tmp_path: Path) -> None:
    interface(tmp_path, "can0", up=True)
    interface(tmp_path, "can1", up=False)
    interface(tmp_path, "vcan0", up=False, virtual=True)
    interface(tmp_path, "eth0", kind=1, up=True)
    interface(tmp_path, "wlan0", kind=1, up=False)
    told = {"can0": Interface("can0", "can", up=True, bitrate=500_000, modes=frozenset({"one-shot"}), restart_ms=100)}
    assert findings(doctor.can(tmp_path, told)) == [
        (True, "can0 is up, 500 kbit/s, one-shot, restarts 100 ms after bus-off: --via rtcan:can0", ""),
        (False, "can1 is down", "sudo ip link set can1 up type can bitrate 1000000 one-shot on restart-ms 100"),
        (False, "vcan0 is down", "sudo ip link set vcan0 up"),
    ]
    assert doctor.network(tmp_path) == Check("interfaces", True, "eth0")


@pytest.mark.parametrize(
    ("there", "ok", "found", "do"),
    [
        (Interface("vcan0", "vcan", up=True), True, "vcan0 is up: --via rtcan:vcan0", ""),
        (
            Interface("can0", "can", up=True, bitrate=125_000, state="error-passive", restart_ms=0, errors=(128, 3)),
            True,
            "can0 is up, 125 kbit/s, error-passive, stays in bus-off, error counters 128 (transmit), 3 (receive); "
            + RETRIES,
            "sudo ip link set can0 down\nsudo ip link set can0 up type can bitrate 125000 one-shot on restart-ms 100",
        ),
        (
            Interface("can0", "can", up=True, state="bus-off", restart_ms=0),
            False,
            "can0 is in bus-off",
            "sudo ip link set can0 type can restart",
        ),
    ],
    ids=["virtual", "not one-shot", "bus-off"],
)
def test_what_the_kernel_tells_of_a_can_interface(
    tmp_path: Path, there: Interface, ok: bool, found: str, do: str
) -> None:
    interface(tmp_path, there.name, up=there.up)
    assert findings(doctor.can(tmp_path, {there.name: there})) == [(ok, found, do)]


def test_no_interfaces_at_all(tmp_path: Path) -> None:
    (check,) = doctor.can(tmp_path)
    assert not check.ok
    assert check.found.startswith("no interface")
    assert "sudo ip link add dev vcan0 up type vcan" in check.do
    assert not doctor.network(tmp_path).ok


def test_serial_ports_that_are_there(tmp_path: Path) -> None:
    """Linux lists ports that the machine could have; their type is 0."""
    for name, kind in (("ttyUSB0", None), ("ttyS0", "4"), ("ttyS1", "0"), ("ttyS2", None), ("tty1", "0")):
        write(tmp_path, f"dev/{name}")
        if kind is not None:
            write(tmp_path, f"sys/class/tty/{name}/type", f"{kind}\n")
    assert findings(doctor.serial_ports(tmp_path)) == [
        (True, f"{tmp_path}/dev/{name}, you may open it: --via serial:{tmp_path}/dev/{name}", "")
        for name in ("ttyUSB0", "ttyS0")
    ]


def test_a_serial_port_of_others_gets_its_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = write(tmp_path, "dev/ttyACM0")
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr(Path, "group", lambda _: "dialout")
    (check,) = doctor.serial_ports(tmp_path)
    assert check == Check(
        "serial",
        False,
        f"{port}: only group dialout may open it",
        "sudo usermod -aG dialout $USER\nthen log in again",
    )


def test_no_serial_port(tmp_path: Path) -> None:
    (check,) = doctor.serial_ports(tmp_path)
    assert (check.ok, check.do) == (False, "plug it in; ls /dev/tty*")


@pytest.mark.parametrize(
    ("governors", "ok", "found"),
    [
        ([], True, "not controlled by this system"),
        (["performance", "performance"], True, "constant"),
        (["powersave", "performance"], False, "changes with the load (performance, powersave): wake-ups take longer"),
    ],
)
def test_cpu_speed(tmp_path: Path, governors: list[str], ok: bool, found: str) -> None:
    for number, governor in enumerate(governors):
        write(tmp_path, f"sys/devices/system/cpu/cpu{number}/cpufreq/scaling_governor", f"{governor}\n")
    check = doctor.governor(tmp_path)
    assert (check.ok, check.found) == (ok, found)
    assert bool(check.do) is not ok


def test_real_time_scheduling(monkeypatch: pytest.MonkeyPatch) -> None:
    resource = pytest.importorskip("resource")
    limit = 0
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit, limit))
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setenv("USER", "ann")
    assert doctor.priority().do.startswith('echo "ann - rtprio 50" | sudo tee /etc/security/limits.d/r2p.conf')
    limit = 50
    assert doctor.priority().found == "priorities up to 50: chrt -f 50 r2p run ..."
    limit = resource.RLIM_INFINITY
    assert doctor.priority().found == "any priority: chrt -f 50 r2p run ..."


def test_packages() -> None:
    assert doctor.package("msgspec", "msgspec", "").ok
    assert doctor.package("no-such-package", "r2p[x]", "the extra x") == Check(
        "no-such-package", False, "not installed: the extra x", "pip install 'r2p[x]'"
    )


def test_how_tools_join(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("R2P_VIA", raising=False)
    assert not doctor.configured().ok
    write(tmp_path, "r2p.toml", 'via = ["tcp:10.0.0.1:23", "serial:/dev/ttyUSB0"]')
    assert doctor.configured().found == "tools join with tcp:10.0.0.1:23 serial:/dev/ttyUSB0"
    write(tmp_path, "r2p.toml", "via = 3")
    assert doctor.configured().do == "correct this file"


def test_lateness() -> None:
    good = doctor.lateness([40_000] * 99 + [200_000])
    assert (good.ok, good.do) == (True, "")
    assert good.found.startswith("at 1 kHz 40 us late (median)")
    late = doctor.lateness([40_000] * 50 + [5_000_000] * 50)
    assert not late.ok
    assert late.do
    assert not doctor.lateness([]).ok


@pytest.mark.virtual_time
async def test_the_measurement_lasts_a_fifth_of_a_second() -> None:
    assert await doctor.measure() == [0] * 200


@pytest.mark.anyio
async def test_the_measurement_on_real_loops() -> None:
    assert all(late >= 0 for late in await doctor.measure())


def test_text_names_each_step() -> None:
    check = Check("serial", False, "not yours", "do this\nand that")
    assert check.text().splitlines() == [
        "lacks  serial        not yours",
        "                     > do this",
        "                     > and that",
    ]
    assert Check("python", True, "3.11").text() == "has    python        3.11"


def test_a_row_at_a_terminal_breaks_between_words_and_a_command_so_that_it_can_be_copied() -> None:
    command = "sudo ip link set can0 up type can bitrate 1000000 one-shot on"
    check = Check("CAN", True, "can0 is up, 1000 kbit/s, error-active: --via rtcan:can0", f"{command}\nthen try again")
    assert check.text(width=60).splitlines() == [
        "has    CAN           can0 is up, 1000 kbit/s, error-active:",
        "                     --via rtcan:can0",
        "                     > sudo ip link set can0 up type can \\",
        "                       bitrate 1000000 one-shot on",
        "                     > then try again",
    ]
    assert check.text(width=120) == check.text()
    assert max(map(len, check.text(width=30).splitlines())) <= 30


# A link


async def findings_of_link(session: Session) -> list[tuple[str, bool, str]]:
    return [(check.what, check.ok, check.found) async for check in doctor.try_link(session)]


@pytest.mark.virtual_time
async def test_a_link_with_modules() -> None:
    async with robot(), robot(name="NEW") as new, tool() as session:
        newer = management.encode(management.Hello("NEW", new.instance, wire=9, release="9.9"))
        await new.stop()
        asyncio.get_running_loop().call_later(0.1, session.module.links[0].manage, newer, 9)
        assert await findings_of_link(session) == [
            ("connects", True, "after 0.0 s"),
            ("module", True, f"BOT: r2p {r2p.__version__}, running, wire version {WIRE_VERSION}"),
            ("module", False, "NEW: r2p 9.9, stopped, wire version 9"),
            ("losses", True, "none"),
        ]


@pytest.mark.virtual_time
async def test_a_link_with_firmware_that_sends_its_name_late() -> None:
    async with Powered(FirmwareModule("IMU1", publishers=[Publishes("leds", Led)])) as power:
        await asyncio.sleep(1.03)  # it has just sent it
        async with r2p.Module("_tool01", via=power.wire(), observer=True, watchdog=False) as module:
            found = await findings_of_link(Session(module, Settings(via=["wire:IMU1"])))
    assert found[1] == ("module", True, "IMU1: firmware, running")


@pytest.mark.virtual_time
async def test_a_link_where_nothing_is_heard_or_only_a_tool() -> None:
    async with tool() as session:
        assert (await findings_of_link(session))[1] == ("modules", False, "no module heard")
    async with tool(), tool() as session:
        assert (await findings_of_link(session))[1] == ("modules", False, "only tools, no module")


@pytest.mark.virtual_time
async def test_a_link_to_something_else_than_r2p() -> None:
    script = Script()
    async with r2p.Module("_tool01", via=script, observer=True, watchdog=False) as module:
        script.hear(b"SSH-2.0-OpenSSH_9.6\r\n" * 8)
        session = Session(module, Settings(via=["tcp:robot1:22"]))
        *_, modules, losses = [check async for check in doctor.try_link(session)]
    assert (modules.found, modules.ok) == ("168 bytes received, none of them r2p", False)
    assert modules.do.startswith("another program listens at this port")
    assert (losses.ok, losses.found) == (False, "garbage 8")


@pytest.mark.anyio
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_link_that_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(r2p.Error, match=r"tcp:localhost:\d+: each failing line above says what to do"):
        await doctor.try_links([f"tcp:localhost:{free_port()}"], Output("json"))
    name, connects = printed(capsys)
    assert (name["check"], name["ok"], connects["check"], connects["ok"]) == ("name", True, "connects", False)
    assert connects["found"].startswith("Connection refused: nothing listens there")
    assert connects["do"].startswith("on the other computer: ss -ltn")


@pytest.mark.anyio
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_link_that_wants_a_key(tmp_path: Path) -> None:
    keys.create(tmp_path / "key")
    server = TcpListenTransport(parse(f"tcp-listen:127.0.0.1:0,key={tmp_path / 'key'}"))
    async with contextlib.AsyncExitStack() as stack:
        await stack.enter_async_context(r2p.Module("BOT", via=server, watchdog=False))
        session = await stack.enter_async_context(join(Settings(via=[f"tcp:127.0.0.1:{server.port}"])))
        *_, check = [check async for check in doctor.try_link(session)]
    assert (check.what, check.ok) == ("key", False)
    assert check.found == "the other end wants a key, and this URL has none: add ?key=FILE to it"
    assert "r2p key new" in check.do


@pytest.mark.anyio
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_the_name_of_a_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    for url in ("tcp:127.0.0.1:23", "tcp:[::1]:23", "tcp:2323", "tcp:127.0.0.1", "serial:/dev/ttyUSB0"):
        assert await doctor.resolve(url) is None
    unknown = await doctor.resolve("tcp:no-such-computer.invalid:23")
    assert unknown is not None
    assert not unknown.ok
    assert unknown.do.startswith("ping no-such-computer.invalid")


@pytest.mark.processes
def test_on_this_machine() -> None:
    with process("doctor", "--format", "json") as child:
        out, err = child.communicate()
    records = [json.loads(line) for line in out.splitlines()]
    assert (child.returncode, err) == (0, "")
    assert {"python", "uvloop", "timers", "CAN", "serial", "real time"} <= {record["check"] for record in records}
    assert all(record["ok"] or record["found"] for record in records)
