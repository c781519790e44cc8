"""Inside the user-mode kernel: `python -m benchmarks.frames_inside FILE` writes what was sent and recorded, as JSON."""

import json
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from r2p.recording.bag import Bag
from r2p.recording.frame_reader import BusReader

NAME = "vcan0"
SECONDS = 10


def sent() -> int:
    """The frames that the interface has carried."""
    return int(Path(f"/sys/class/net/{NAME}/statistics/tx_packets").read_text(encoding="ascii"))


def record(path: Path) -> None:
    """Record the bus, as a user does, while cangen sends as fast as it can."""
    command = [sys.executable, "-m", "r2p", "bag", "record", "--frames", "--via", f"rtcan:{NAME}"]
    recorder = subprocess.Popen([*command, "-o", str(path), "--min-free", "0"], stderr=subprocess.PIPE, text=True)
    assert recorder.stderr is not None
    while "is up" not in (line := recorder.stderr.readline()):
        if not line:
            raise SystemExit("the recorder ended before the interface was up")
    generator = ("cangen", NAME, "-e", "-g", "0", "-L", "8", "-I", "i", "-D", "i")
    subprocess.run(("timeout", str(SECONDS), *generator), check=False)
    recorder.send_signal(signal.SIGINT)
    print(recorder.communicate()[1])


def main(file: str) -> None:
    subprocess.run(("ip", "link", "add", "dev", NAME, "up", "type", "vcan"), check=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bus.mcap"
        record(path)
        with Bag(path) as bag:
            reader = BusReader(bag)
            recorded, lost = reader.counts[NAME], reader.lost(NAME).total()
    found = {"sent": sent(), "recorded": recorded, "lost": lost, "seconds": SECONDS}
    Path(file).write_text(json.dumps(found), encoding="ascii")


if __name__ == "__main__":
    main(sys.argv[1])
