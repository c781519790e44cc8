"""`r2p bus`: what an RTCAN bus carries, who has which slots, and what would still fit."""

from r2p.tools import session
from r2p.tools.bus_admit import admit
from r2p.tools.bus_dump import dump
from r2p.tools.bus_load import load
from r2p.tools.bus_schedule import schedule

app = session.group("An RTCAN bus: its load, its frames, its slots.")
for _body in (load, dump, schedule, admit):
    app.command()(_body)
