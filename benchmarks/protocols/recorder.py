"""What became of each message: releases, frames on the bus, and what follows from them. Times in ns, true time."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    from benchmarks.protocols.message_sets import SetMessage


class MessageInstance(msgspec.Struct, eq=False):
    """One value of a message: when it was released, the start of its first frame, the end of its last one (0: none)."""

    released: int
    start: int = 0
    end: int = 0


class MessageTrack(msgspec.Struct, eq=False):
    """All instances of one message.

    `paced`: the protocol asks for each value, every `period` ns; otherwise the node releases them by its own clock.
    """

    message: SetMessage
    period: int
    paced: bool = False
    instances: list[MessageInstance] = []

    def release(self, at: int) -> MessageInstance:
        """Note a new value."""
        instance = MessageInstance(at)
        self.instances.append(instance)
        return instance

    def judge(self, begin: int, end: int) -> MessageVerdict:
        """Return what came of the instances that were released from `begin` on and were due before `end`."""
        deadline = self.message.deadline
        due = [each for each in self.instances if begin <= each.released and each.released + deadline < end]
        sent = [each for each in due if each.end]
        late = sum(each.end > each.released + deadline for each in sent)
        starts = sorted(each.start for each in sent)
        gaps = [after - before for before, after in pairwise([begin, *starts, end - deadline])]
        if self.paced:  # without a sync there is not even an instance: what counts is the time in which one was due
            count = max(1, (end - deadline - begin) // self.period)
            absent = sum(max(0, (gap + self.period // 2) // self.period - 1) for gap in gaps)
            missed = min(count, absent + late)
        else:
            count, missed = len(due), len(due) - len(sent) + late
        return MessageVerdict(
            self.message,
            count,
            missed,
            [each.end - each.released for each in sent],
            0 if self.message.sporadic else _worst_jitter(starts, self.period),
            max(gaps),
        )


class MessageVerdict(msgspec.Struct, eq=False):
    """What came of one message: how many were due, how many were not there by their deadline, response times.

    `jitter`: how far the time between two starts of frame was off whole periods at most; `silence`: the longest time
    without a start of frame.
    """

    message: SetMessage
    count: int
    missed: int
    responses: list[int]
    jitter: int
    silence: int


def _worst_jitter(starts: list[int], period: int) -> int:
    worst = 0
    for before, after in pairwise(starts):
        gap = after - before
        periods = max(1, (gap + period // 2) // period)
        worst = max(worst, abs(gap - periods * period))
    return worst
