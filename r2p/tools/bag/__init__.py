"""`r2p bag`: recordings of topics, CAN frames and what happened to them, in files.

`record` writes a file, and `convert` makes files of other formats of it, and it of those. `info`, `echo` and `frames`
show what is in one; `edit` has `cut` and `merge`, and `recover` makes a file whole that was cut off.
"""

from r2p.tools import session
from r2p.tools.bag import convert, echo, edit, events, frames, info, record
from r2p.tools.bag.recover import recover

app = session.group("Record topics to a file, and play, inspect and convert it.")
session.command(app, "record", endless=lambda _given: True, check=record.check, joins=record.has_topics)(record.record)
app.command("frames")(session.standalone(frames.frames))
app.command("convert")(session.standalone(convert.convert))
app.command("recover")(session.standalone(recover))
app.command("events")(session.standalone(events.events))
app.command("slots")(session.standalone(events.slots))
app.command("info")(session.standalone(info.info))
app.command("echo")(session.standalone(echo.echo))
app.command("cut")(session.standalone(edit.cut))
app.command("merge")(session.standalone(edit.merge))
