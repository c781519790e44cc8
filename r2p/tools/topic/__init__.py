"""`r2p topic`: the group of commands.

`list` (with `info` and `find`), `echo`, `pub`, `rates` (`hz`, `bw`, `delay`) and `plot` are the commands; `watching` is
their common code.
"""

from r2p.tools import session
from r2p.tools.topic import echo as topic_echo
from r2p.tools.topic import list as topic_list
from r2p.tools.topic import plot as topic_plot
from r2p.tools.topic import pub as topic_pub
from r2p.tools.topic import rates as topic_rates
from r2p.tools.topic.watching import check_type

app = session.group("List, watch, publish and measure topics.")

session.command(app, "list")(topic_list.list_)
session.command(app, "info")(topic_list.info)
session.command(app, "find")(topic_list.find)
session.command(app, "echo", check=check_type)(topic_echo.echo)
session.command(app, "pub", endless=topic_pub.goes_on, check=check_type)(topic_pub.pub)
session.command(app, "hz")(topic_rates.hz)
session.command(app, "bw")(topic_rates.bw)
session.command(app, "delay")(topic_rates.delay)
session.command(app, "plot", endless=lambda _given: True)(topic_plot.plot)
