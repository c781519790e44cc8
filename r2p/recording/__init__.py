"""Recordings ("bags"): MCAP files with messages, CAN frames, and what happened to them on their way.

`format` says what is in a file: start there. `samples` turns samples into records and back, with the classes of `types`
and the messages of `messages`; `writer` writes the records. `bag` reads them: of each `bag_file` what its `summary`
says is in its `channels` and chunks, by `records`, which trusts no number in a file. `editing` makes new bags of old
ones.

A `recorder` subscribes to topics (`topics`), and hands what they receive, as `entries`, to the thread of `disk`;
`observations` and `frame_recorder` are its other parts. `files` decides where a file ends, and what a full disk costs;
`mcap_file` writes one, and `recovery` makes one whole that was cut off. `player` publishes what is in a bag, by the
publishers of `played`, at the times that `pacing` keeps.

CAN frames: `frames` says how they are written, `frame_reader` reads them, and `frame_player` plays them onto a bus.

Raises BagError on import where the extra is not installed.
"""

import importlib.util

from r2p.errors import BagError

if importlib.util.find_spec("mcap") is None:
    raise BagError("recordings need mcap: pip install 'r2p[bag]'")
