"""A zenoh router that knows nothing of r2p: `python -m tests.transports.zenoh.router PORT`, ends with its input.

It is zenohd's own code, in the library. Says `ready` when it listens on that port of loopback.
"""

import json
import sys

import zenoh


def main(port: str) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.read()


if __name__ == "__main__":
    main(sys.argv[1])
