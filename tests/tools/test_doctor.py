"""`r2p doctor`, on machines that are made up."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from r2p.tools import doctor
from r2p.tools.doctor import Check
from r2p.transports.can.netlink import Interface
from tests.tools.rig import process

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
        "lacks  serial      not yours",
        "                   > do this",
        "                   > and that",
    ]
    assert Check("python", True, "3.11").text() == "has    python      3.11"


@pytest.mark.processes
def test_on_this_machine() -> None:
    with process("doctor", "--format", "json") as child:
        out, err = child.communicate()
    records = [json.loads(line) for line in out.splitlines()]
    assert (child.returncode, err) == (0, "")
    assert {"python", "uvloop", "timers", "CAN", "serial", "real time"} <= {record["check"] for record in records}
    assert all(record["ok"] or record["found"] for record in records)
