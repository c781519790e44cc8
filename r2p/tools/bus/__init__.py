"""`r2p bus`: what an RTCAN bus carries, how its slots are used, and what still fits. All commands only listen.

`load`, `dump`, `schedule` and `admit` are the commands; `load` also has how they open a bus, `picture` draws slots.
"""

from r2p.tools import session
from r2p.tools.bus import admit, dump, load, schedule

app = session.group("Inspect an RTCAN bus: load, frames, slots.")
for _body in (load.load, dump.dump, schedule.schedule, admit.admit):
    app.command()(_body)
