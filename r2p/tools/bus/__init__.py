"""`r2p bus`: what an RTCAN bus carries, who has which slots, and what would still fit."""

from r2p.tools import session
from r2p.tools.bus import admit, dump, load, schedule

app = session.group("An RTCAN bus: its load, its frames, its slots.")
for _body in (load.load, dump.dump, schedule.schedule, admit.admit):
    app.command()(_body)
