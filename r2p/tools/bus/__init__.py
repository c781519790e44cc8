"""`r2p bus`: what an RTCAN bus carries, how its slots are used, and what still fits; and a simulated bus for others.

`traffic` has `load`, `dump`, and how a command opens a bus; `slots` has `schedule` and `admit`, and draws the cycle;
`analyze` computes worst cases, of a file or of a live bus: `live` has what was measured there. These only listen; with
`reported`, `analyze` asks the modules of any network instead. `serve` runs a simulated bus.
"""

from r2p.tools import session
from r2p.tools.bus import analyze, serving, slots, traffic

app = session.group("Inspect an RTCAN bus: load, frames, slots, worst cases. Serve a simulated one.")
session.command(app, "load", opening=traffic.listen)(traffic.load)
session.command(app, "dump", opening=traffic.listen)(traffic.dump)
session.command(app, "schedule", opening=traffic.listen)(slots.schedule)
app.command()(slots.admit)
app.command("analyze")(session.standalone(analyze.analyze))
app.command("serve")(session.service(serving.serve))
