"""Changes to messages on the way from one format to the other: other types."""

from collections import Counter
from collections.abc import Callable, Iterable
from typing import TypeAlias

import msgspec

from r2p.errors import BagError, DecodeError, MessageError
from r2p.messages import Message, layout
from r2p.recording.convert.stream import ConversionOptions, ConvertedRecord, Losses
from r2p.ros.conversions import NO_NAMES, Conversion, RosNames, conversion, standard_type
from r2p.ros.stamps import StampSource

_Change: TypeAlias = Callable[[ConvertedRecord], Iterable[ConvertedRecord]]


class Retyping:
    """Gives messages the types that the options ask for; `version` is the ROS whose standard types `ros` means."""

    def __init__(self, options: ConversionOptions, version: int, losses: Losses) -> None:
        self._options = options
        self._version = version
        self._losses = losses
        self._changes: dict[tuple[str, type[Message] | None], _Change] = {}

    def __call__(self, record: ConvertedRecord) -> Iterable[ConvertedRecord]:
        """Return the messages that take the place of one: the same, converted ones, or none for a lost one.

        A lost message is counted. Raises BagError.
        """
        key = record.topic, record.cls
        change = self._changes.get(key)
        if change is None:
            change = self._changes[key] = self._find(*key)
        return change(record)

    def _find(self, topic: str, cls: type[Message] | None) -> _Change:
        stated = self._options.type_of(topic) if cls is None else self._options.stated(topic)
        if stated is None:
            return self._to_standard(topic, cls) if self._options.ros and cls is not None else _same
        if cls is None:
            return self._typed(topic, stated)
        if layout(cls).schema == layout(stated).schema:
            return lambda record: (msgspec.structs.replace(record, cls=stated),)
        return self._from_ros(topic, cls, stated)

    def _typed(self, topic: str, cls: type[Message]) -> _Change:
        """Return what gives messages of unknown type a class."""
        decode = layout(cls).decode
        problem = f"messages of {topic} of another type than {layout(cls).name}, kept as bytes"

        def change(record: ConvertedRecord) -> Iterable[ConvertedRecord]:
            try:
                decode(record.sample.data)
            except DecodeError:
                self._losses[problem] += 1
                return (record,)
            return (msgspec.structs.replace(record, cls=cls),)

        return change

    def _from_ros(self, topic: str, cls: type[Message], stated: type[Message]) -> _Change:
        """Return what makes r2p's messages of those of a ROS type."""
        ours, theirs = layout(stated).name, layout(cls).name
        found = next((each for version in (2, 1) if (each := _conversion(stated, theirs, version)) is not None), None)
        if found is None:
            raise BagError(f"{topic} has messages of type {theirs}, which do not become {ours}")
        decode, from_ros, problem = cls.decode, found.from_ros, f"messages of {topic} that {ours} can't have"

        def change(record: ConvertedRecord) -> Iterable[ConvertedRecord]:
            try:
                data = from_ros(decode(record.sample.data)).encode()
            except (DecodeError, MessageError):
                self._losses[problem] += 1
                return ()
            self._count(topic, ours, found.lost_from_ros)
            return (_with_data(record, data, stated),)

        return change

    def _to_standard(self, topic: str, cls: type[Message]) -> _Change:
        """Return what makes ROS's standard messages of r2p's."""
        name = standard_type(cls, self._version)
        found = None if name is None else _conversion(cls, name, self._version, RosNames(topic))
        if found is None:
            return _same
        stamps, problem = StampSource(cls, Counter()), f"messages of {topic} that {name} can't have"
        to_ros, theirs, theirs_name = found.to_ros, found.theirs, layout(found.theirs).name

        def change(record: ConvertedRecord) -> Iterable[ConvertedRecord]:
            sample = record.sample
            try:
                made = to_ros(cls.decode(sample.data), stamps.find(sample), sample.source)
            except (DecodeError, MessageError):
                self._losses[problem] += 1
                return ()
            self._count(topic, theirs_name, found.lost_to_ros)
            return [_with_data(record, each.encode(), theirs) for each in made]

        return change

    def _count(self, topic: str, became: str, without: str) -> None:
        if without:
            self._losses[f"messages of {topic} became {became}, without {without}"] += 1


def _same(record: ConvertedRecord) -> Iterable[ConvertedRecord]:
    return (record,)


def _conversion(ours: type[Message], theirs: str, version: int, names: RosNames = NO_NAMES) -> Conversion | None:
    try:
        return conversion(ours, theirs, version, names)
    except MessageError as error:
        raise BagError(str(error)) from None


def _with_data(record: ConvertedRecord, data: bytes, cls: type[Message]) -> ConvertedRecord:
    sample = msgspec.structs.replace(record.sample, data=data, message=None)
    return msgspec.structs.replace(record, sample=sample, cls=cls)
