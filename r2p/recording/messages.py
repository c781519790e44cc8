"""Messages that a recorder writes beside those of the topics."""

from typing import Annotated

from r2p.messages import Max, Message, i64, u8, u64

REST_MAX = 1 << 16


class SampleMeta(Message, name="r2p_msgs/SampleMeta"):
    """What a message had besides its bytes. A message that has all of this as by default here has no companion.

    `deadline` and `expires` are instants (UTC, ns; 0: none) by the publisher's clock and by the recorder's; `expires` 0
    is the same as `deadline`. `clock_epoch`, `clock_offset` and `clock_error` (ns) are the translation of the stamp
    from the clock of that RTCAN network; without one, the error is -1. `number` is the publisher's, where it does not
    fit the 32 bits of the sequence (0: it does). `rest` is what CDR can't hold of the packed message.
    """

    stamped: bool = True
    drop_late: bool = True
    hops: u8 = 0
    deadline: i64 = 0
    expires: i64 = 0
    clock_epoch: i64 = 0
    clock_offset: i64 = 0
    clock_error: i64 = -1
    number: u64 = 0
    rest: Annotated[bytes, Max(REST_MAX)] = b""
