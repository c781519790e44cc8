"""The network for programs that speak WebSocket: browsers (`dash`) and Foxglove (`foxglove`), served by this process.

`server` is the one listener below both: it serves files, checks who may connect, and bounds what a client costs.

Raises WebError on import where the extra is not installed.
"""

import importlib.util

from r2p.errors import WebError

if importlib.util.find_spec("websockets") is None:
    raise WebError("pages and Foxglove need websockets: pip install 'r2p[web]'")
