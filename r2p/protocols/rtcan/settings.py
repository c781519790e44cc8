"""What the owner of a node decides about its RTCAN."""

import msgspec

from r2p.protocols.rtcan.events import Profile


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """One node on one bus. Times in ns.

    - `number`: 64 random bits. `id8`: 1..255, None: claim a free one. `priority`: to be the master, 0: never.
    - `slots`, `cycle` (nominal), `bit_rate` must be the same in the whole network.
    - `listen`: how long before anything is sent. `receive_latency`: from the end of a frame to its stamp.
      `transmit_latency`: from the hand-over of a frame to its start. `coarse`: the port can't hit a slot; so a frame
      may start anywhere in a run of free slots.
    - `reserves`: ask for slots for periodic messages. `capacity`: messages that wait.
    """

    number: int
    id8: int | None = None
    priority: int = 0
    profile: Profile = Profile.AUTO
    slots: int = 60
    cycle: int = 10_000_000
    bit_rate: int = 1_000_000
    listen: int = 1_200_000_000
    receive_latency: int = 0
    transmit_latency: int = 0
    coarse: bool = False
    reserves: bool = True
    capacity: int = 256
