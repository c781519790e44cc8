"""Units for systemd that run the commands of a file: a service for each, and a target for all of them.

systemd does what `r2p launch` does. A service that is to be ready before others has `r2p launch --ready` in its
ExecStartPost: systemd starts the others when that has ended. They start even if it has failed, as the hardware may
appear, and the service be started again, long after the others have given up.
"""

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from r2p.tools.config import CONFIG, CONFIG_VARIABLE, VIA_VARIABLE, UsageError
from r2p.tools.launch.entries import Entry
from r2p.tools.launch.group import USAGE
from r2p.tools.launch.processes import command_line
from r2p.tools.output import notify

_MARK = "# Written by `r2p launch --systemd`"
_RESTART = {"never": "no", "on-failure": "on-failure", "always": "always"}
_RESTART_PAUSE = 2  # seconds
_MARGIN = 5  # seconds that systemd waits beyond ready_timeout, in which the error is reported


def write(path: Path, entries: list[Entry], directory: Path, via: Sequence[str] | None) -> None:
    """Write the units into a directory. Raises UsageError for files that something else has written."""
    units = make_units(path, entries, via or ())
    files = {directory / name: text for name, text in units.items()}
    try:
        for file in files:
            if file.exists() and not file.read_text(errors="replace").startswith(_MARK):
                raise UsageError(f"{file} exists, and r2p has not written it: choose another --output")
        directory.mkdir(parents=True, exist_ok=True)
        for file, text in files.items():
            file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"can't write the units: {error}") from error
    notify(f"units written: {', '.join(units)}; install them by")
    notify(f"sudo cp {' '.join(map(str, files))} /etc/systemd/system/")
    notify(f"sudo systemctl daemon-reload && sudo systemctl enable --now {_robot(path)}.target")


def make_units(path: Path, entries: list[Entry], via: Sequence[str]) -> dict[str, str]:
    """Return the texts of the units by name: ROBOT.target, and ROBOT-NAME.service for each entry.

    ROBOT is the name of the file, or of its directory if the file is r2p.toml; `via` replaces that of the file.
    """
    units = {f"{_robot(path)}.target": _target(path, entries)}
    units |= {_service_name(path, entry.name): _service(path, entry, via) for entry in entries}
    head = f"{_MARK} from {path}: change that file, then write the units again."
    return {name: "\n".join([head, *lines, ""]) for name, lines in units.items()}


def _robot(path: Path) -> str:
    name = path.parent.name if path.name == CONFIG else path.stem
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name) or "r2p"


def _service_name(path: Path, entry: str) -> str:
    return f"{_robot(path)}-{entry}.service"


def _target(path: Path, entries: list[Entry]) -> list[str]:
    required = " ".join(_service_name(path, entry.name) for entry in entries if entry.required)
    return [
        "[Unit]",
        f"Description={_robot(path)}",
        "Wants=" + " ".join(_service_name(path, entry.name) for entry in entries),
        *([f"BindsTo={required}", f"After={required}"] if required else []),
        "",
        "[Install]",
        "WantedBy=multi-user.target",
    ]


def _service(path: Path, entry: Entry, via: Sequence[str]) -> list[str]:
    before = " ".join(_service_name(path, name) for name in entry.after)
    return [
        "[Unit]",
        f"Description={_robot(path)}: {entry.name}",
        f"PartOf={_robot(path)}.target",
        *([f"Wants={before}"] if before else []),
        f"After={before or 'network.target'}",
        "",
        "[Service]",
        *(["Type=oneshot", "RemainAfterExit=yes"] if entry.ends else ["Type=exec"]),
        f"WorkingDirectory={_escaped(str(path.parent))}",
        *_environment(path, entry, via),
        "ExecStart=" + _command_line(*entry.arguments),
        *(["ExecStartPost=" + _command_line("launch", "--ready", entry.name)] if entry.ports or entry.seen else []),
        f"Restart={_RESTART[entry.restart]}",
        f"RestartSec={_RESTART_PAUSE}",
        f"RestartPreventExitStatus={USAGE}",
        f"TimeoutStartSec={entry.ready_timeout + _MARGIN:g}",
        f"TimeoutStopSec={entry.stop_timeout:g}",
        *_user(),
        "",
        "[Install]",
        f"WantedBy={_robot(path)}.target",
    ]


def _environment(path: Path, entry: Entry, via: Sequence[str]) -> Iterator[str]:
    variables = {CONFIG_VARIABLE: str(path), "PYTHONUNBUFFERED": "1"}
    if via:
        variables[VIA_VARIABLE] = " ".join(via)
    for name, value in (variables | entry.environment).items():
        yield f"Environment={_word(f'{name}={value}')}"


def _user() -> list[str]:
    """Return the user who writes the units, unless that is root."""
    if os.name != "posix" or os.geteuid() == 0:
        return []
    import pwd

    return [f"User={pwd.getpwuid(os.geteuid()).pw_name}"]


def _command_line(*arguments: str) -> str:
    return " ".join(_word(word).replace("$", "$$") for word in command_line(*arguments))


def _word(text: str) -> str:
    """Return a word in systemd's quoting."""
    quoted = _escaped(text).replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{quoted}"' if not quoted or any(each in quoted for each in " \t'\";\\") else quoted


def _escaped(text: str) -> str:
    return text.replace("%", "%%")
