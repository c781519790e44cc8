"""Second line of defence: messages that say who published them are recognised when they come again."""

from r2p.sample import Sample

_KEPT = 64  # of each publisher
_PUBLISHERS = 1024


class Seen:
    """The last messages of each publisher of a topic. One that comes again has the same number and the same stamp."""

    def __init__(self) -> None:
        self._stamps: dict[tuple[str, str], list[int]] = {}

    def again(self, sample: Sample) -> bool:
        """Whether it has been here; from now on it has."""
        source = sample.source
        key = (source.module, source.node)
        stamps = self._stamps.get(key)
        if stamps is None:
            if len(self._stamps) >= _PUBLISHERS:
                self._stamps.clear()
            stamps = self._stamps[key] = [0] * _KEPT
        place = sample.sequence % _KEPT
        if stamps[place] == sample.stamp:
            return True
        stamps[place] = sample.stamp
        return False
