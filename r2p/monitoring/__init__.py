"""What is known of a running network, once a second, for tools that show it: `r2p top`, `r2p dash`, `r2p foxglove`.

`snapshot` has the figures: of modules, topics, services, links and buses. A `NetworkMonitor` collects them, from what
is announced, from the statistics that modules count themselves, and from `bus_load` and `bus_slots`. It subscribes to
no topic of the robot unless a tool asks for one to be measured.

`topic_types` finds the message classes of topics, and `log` follows the log records of all modules.
"""
