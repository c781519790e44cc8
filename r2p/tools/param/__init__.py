"""`r2p param`: the group of commands.

`reading` (`list`, `get`, `info`, `dump`, `watch`) and `changing` (`set`, `load`, `reset`, `save`) are the commands.
`arguments` are their arguments, `targets` finds the parameters that these mean, `texts` writes them
for people and for files, and `firmware` does `list`, `get` and `set` with the config area of an app of firmware.
"""

from r2p.tools import session
from r2p.tools.param import changing, reading
from r2p.tools.session import counts_without_end

app = session.group("List, get, set and save parameters of nodes.")

session.command(app, "list")(reading.list_)
session.command(app, "get")(reading.get)
session.command(app, "set", takes_numbers=True)(changing.set_)
session.command(app, "dump")(reading.dump)
session.command(app, "load")(changing.load)
session.command(app, "watch", endless=counts_without_end)(reading.watch)
session.command(app, "reset")(changing.reset)
session.command(app, "save")(changing.save)
session.command(app, "info")(reading.info)
