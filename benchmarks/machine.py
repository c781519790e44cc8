"""What the figures depend on: the processor, its governor, the kernel and its settings, and what else runs."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

SETTINGS = (
    "net/core/rmem_max",
    "net/core/wmem_max",
    "net/ipv4/tcp_rmem",
    "net/ipv4/tcp_wmem",
    "net/ipv4/tcp_congestion_control",
    "kernel/sched_autogroup_enabled",
    "kernel/timer_migration",
    "vm/swappiness",
)
"""Of sysctl: those that move rates and latencies on the loopback interface."""

PEERS = ("uvloop", "msgspec", "eclipse-zenoh", "cyclonedds", "lcm", "pycyphal", "pycyphal2", "python-can", "mcap")

BUSY = 0.25
"""Share of the cores that others may use while figures are taken that are to be published."""


def describe() -> dict[str, str]:
    """The machine, its settings and the load of the last minute, by name."""
    settings = {path.replace("/", "."): _read(f"/proc/sys/{path}") for path in SETTINGS}
    return {
        "processor": f"{_processor()}, {os.cpu_count()} cores",
        "governor": _read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"),
        "kernel": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "load": load(),
        **{name: value for name, value in settings.items() if value != "not there"},
        **{name: _version(name) for name in PEERS},
    }


def load() -> str:
    """How many programs wanted a core in the last minute; busy: more than the machine should have to do."""
    mean = os.getloadavg()[0]
    return f"{mean:.2f}" + ": busy" * (mean > BUSY * (os.cpu_count() or 1))


def lines(machine: dict[str, str]) -> list[str]:
    """For above the table."""
    names = ("processor", "governor", "kernel", "python", "load")
    settings = (f"{name}={value}" for name, value in machine.items() if "." in name)
    return ["; ".join(f"{name} {machine[name]}" for name in names), "sysctl " + ", ".join(settings)]


def _read(path: str) -> str:
    try:
        return " ".join(Path(path).read_text().split())
    except OSError:
        return "not there"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not there"


def _processor() -> str:
    for line in _read_lines("/proc/cpuinfo"):
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()


def _read_lines(path: str) -> list[str]:
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []
