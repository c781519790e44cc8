"""What is known of a running network, once a second, for tools that show it: `r2p top`, `r2p dash`, `r2p foxglove`.

`snapshot` has the figures: of modules, topics, services, links and buses. A `NetworkMonitor` (`monitor`) collects them:
from what is announced; from the statistics that modules count themselves (`polling` asks for them, `counters` has the
answers, `rates` what happened between two); from `bus_load` and `bus_slots` (`buses`); and from topics that a tool asks
for (`measuring`). `rows` makes one row of all that. It subscribes to no other topic of the robot.

`topic_types` finds the message classes of topics, and `log` follows the log records of all modules.
"""
