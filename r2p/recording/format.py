"""What a bag is: an MCAP file (https://mcap.dev) of profile `ros2`, with r2p's own channels and metadata.

    metadata record `r2p`   `format`: FORMAT; `r2p`: the version of r2p that wrote the file
    metadata `r2p/latched`  a key for each topic that its publisher latches; of several such records, the last counts
    channel /TOPIC          the messages of one publisher, in one class, by one link: `ChannelInfo` in its metadata.
                            Encoding `cdr` with a `ros2msg` schema; `r2p`, without one, if their type is unknown, or
                            one that ROS can't define
    channel /r2p/meta/TOPIC its companion, with the same metadata: what of a message is not the default (`SampleMeta`)
    channels /r2p/...       what the recorder saw besides, as the messages of `r2p.recording.messages`
    channels /BUS/frames    CAN frames, as `can_msgs/msg/Frame`: one for each direction
    .../BUS/frames/details  what that has no field for, and frames that were lost: `r2p.recording.frames`

A message's log time is that of its reception, its publish time the stamp of its publisher; without a stamp both are the
same, and the companion says so. Its sequence has the lowest 32 bits of the publisher's number; where the publisher has
none, the recorder counts (`ChannelInfo.numbered`). A record of the companion has the log time and the sequence of its
message, and stands directly before it.

Schemas and channels stand before the chunks, and chunks have nothing but messages. A chunk ends after half a second at
the latest, and has an index and a checksum; so have the attachments, the data in front of the summary, and the summary.
Each file of a recording that was split has all channels, attachments and metadata so far, and the channels have the
same ids.
"""

import struct
from collections.abc import Mapping
from typing import Final, Self

import msgspec

from r2p.codecs import PublisherClass
from r2p.errors import DecodeError

FORMAT = 1
"""The version of the format; a reader knows all up to its own."""

PROFILE = "ros2"
METADATA = "r2p"
"""The name of the metadata record."""
LATCHED = "r2p/latched"
"""The name of the one with the topics that are latched."""

CDR = "cdr"
PACKED = "r2p"
"""The encoding of a message as r2p packs it (PROTOCOL.md 2)."""

OWN_PREFIX = "/r2p/"
META_PREFIX = f"{OWN_PREFIX}meta/"
"""Before the name of a topic: the channel of the companion."""

SEQUENCE_MASK = 0xFFFF_FFFF

# Records of MCAP: of those that the library `mcap` reads and writes too slowly

MAGIC: Final = b"\x89MCAP0\r\n"
"""The beginning of a file, and its end."""
RECORD_HEAD: Final = struct.Struct("<BQ")
"""Of each record: its opcode, and the bytes behind this."""
MESSAGE: Final = struct.Struct("<HIQQ")
"""Of a message, before its data: channel, sequence, log time, publish time."""
MESSAGE_RECORD: Final = struct.Struct("<BQHIQQ")
"""Both in one."""
INDEX: Final = struct.Struct("<HI")
"""Of a channel's index behind a chunk, before its entries: channel, and the bytes of all entries."""
INDEX_ENTRY: Final = 16
"""Bytes of one: log time, and offset in the chunk."""


class ChannelInfo(msgspec.Struct, frozen=True):
    """One channel of messages: a topic, its publisher, the class in which it publishes, and the link they came by.

    Names that the link does not carry are empty, and `link` is for messages of the recording module itself. `type` is
    the full name of the type, and `schema` its layout (`r2p.Layout.schema`); both are empty where it is unknown.
    `numbered`: whether the sequence numbers are the publisher's.
    """

    topic: str
    module: str = ""
    node: str = ""
    publisher_class: PublisherClass = PublisherClass.NON_REAL_TIME
    link: str = ""
    numbered: bool = True
    type: str = ""
    schema: str = ""

    @property
    def metadata(self) -> dict[str, str]:
        """The metadata of the channel in the file."""
        return {
            "topic": self.topic,
            "module": self.module,
            "node": self.node,
            "class": self.publisher_class.name.lower(),
            "link": self.link,
            "numbered": "yes" if self.numbered else "no",
            "type": self.type,
            "schema": self.schema,
        }

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self | None:
        """Parse the metadata of a channel; return None for a channel that is not of this kind.

        Raises DecodeError for a class of publishers that is unknown here.
        """
        if "topic" not in metadata:
            return None
        name = metadata.get("class", "")
        try:
            publisher_class = PublisherClass[name.upper()]
        except KeyError:
            raise DecodeError(f"{name!r} is not a class of publishers") from None
        texts = {field: metadata.get(field, "") for field in ("topic", "module", "node", "link", "type", "schema")}
        texts["topic"] = texts["topic"].lstrip("/")  # a name is not another one with a slash before it
        return cls(publisher_class=publisher_class, numbered=metadata.get("numbered") == "yes", **texts)
