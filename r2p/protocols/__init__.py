"""State machines without I/O: time (`now`, monotonic ns) and bytes go in, events and `next_deadline()` come out.

- `discovery`: modules, topics and subscriptions on a link, by management messages; `liveliness`: the same on zenoh.
- `rtcan`: the CAN protocol, with its cycle, its master and its slots.
- `bridge`: the tree of gateways, and the choice of a module with several links.
- `flow_control`, `time_left`, `timers`: parts that several links or protocols use.
- `can_orders`: orders and answers between RTCAN and the ports to CAN controllers.
"""
