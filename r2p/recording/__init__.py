"""Recordings ("bags"): MCAP files with messages, CAN frames, and what happened to them on their way.

`format` says what is in a file: start there. `samples` turns samples into records and back, with the classes of `types`
and the messages of `messages`; `writer` puts records into chunks, and `mcap_writer` writes the file. `bag` reads it: of
each `bag_file` what its `summary` says is in its `channels` and chunks, by `mcap_reader`, which trusts no number in a
file. `message_index` finds a few messages of a chunk without the others. `editing` makes new bags of old ones, and
`recovery` a whole one of one that was cut off.

A `recorder` subscribes to topics (`topics`), and hands what they receive, as `entries`, to the thread of
`background_writer`; `recording_files` decides where a file ends, and what a full disk costs. Its other parts are
`frame_recorder` and `observations`, with `bus_watch` and `module_watch`; `timeline` reads what these saw.
`player` publishes what is in a bag, by each `played_publisher`, at the times that `pacing` keeps.

CAN frames: `frames` says how they are written, `frame_reader` reads them, and `frame_player` plays them onto a bus. The
files of other programs are the matter of `convert`.

Raises BagError on import where the extra is not installed.
"""

import importlib.util

from r2p.errors import BagError

if importlib.util.find_spec("mcap") is None:
    raise BagError("recordings need mcap: pip install 'r2p[bag]'")
