"""Analysis of a CAN bus before it is built: worst-case response times, and how short the slots of RTCAN may be.

    from r2p.analysis import BusMessage, bit_time, response_bounds

    messages = [BusMessage(name="tilt", id=0x20, size=8, period=10_000_000, deadline=5_000_000), ...]
    for found in response_bounds(messages, bit_time(500_000)):
        print(found.message.name, found.bound, "may be late" if found.misses else "in time")

All of it are pure functions, and all times are integer nanoseconds. Read `messages` first (what is analysed), then
`priority` (plain CAN), `slots` (free slots, guards) and `laxity` (events of RTCAN). `tables` reads and writes message
sets as CSV and TOML, `dbc` as DBC files. The command `r2p bus analyze` uses it.
"""

from r2p.analysis.laxity import EventModel, control_rates, event_bounds, event_breakdown, management_load
from r2p.analysis.messages import BusMessage, MessageClass, Urgency, bit_time, check_message, utilisation
from r2p.analysis.priority import (
    Breakdown,
    FaultModel,
    ResponseBound,
    breakdown,
    fault_probabilities,
    miss_probability,
    response_bounds,
)
from r2p.analysis.slots import SlotAccuracy, SlotSupply, guard_time, slot_supply, smallest_slot

__all__ = [
    "Breakdown",
    "BusMessage",
    "EventModel",
    "FaultModel",
    "MessageClass",
    "ResponseBound",
    "SlotAccuracy",
    "SlotSupply",
    "Urgency",
    "bit_time",
    "breakdown",
    "check_message",
    "control_rates",
    "event_bounds",
    "event_breakdown",
    "fault_probabilities",
    "guard_time",
    "management_load",
    "miss_probability",
    "response_bounds",
    "slot_supply",
    "smallest_slot",
    "utilisation",
]
