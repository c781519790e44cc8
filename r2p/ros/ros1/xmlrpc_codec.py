"""XMLRPC's XML: calls and answers of ROS 1's master and nodes, encoded and parsed.

    <?xml version='1.0'?>
    <methodCall><methodName>getPid</methodName><params><param><value><string>/me</string></value></param></params>
    </methodCall>

    <methodResponse><params><param><value>...</value></param></params></methodResponse>
    <methodResponse><fault><value><struct>faultCode, faultString</struct></value></fault></methodResponse>

Values are `int` (32 bits), `boolean`, `double`, `string` (the default: roscpp leaves the tag out), `base64`, `array`,
and `struct`. Python's own marshalling does the work. Here it gets bounds: no document types, so no entities that
expand; a depth; and what XML can't carry is replaced rather than sent.
"""

import re
import xmlrpc.client
from typing import Any, Final, cast
from xml.parsers import expat

import msgspec

from r2p.errors import DecodeError

Value = None | bool | int | float | str | bytes | list["Value"] | dict[str, "Value"]
"""What XMLRPC carries."""

DEPTH_MAX: Final = 192
"""Tags around a tag; a struct in a struct takes three more, so that parameters may be 60 deep."""

_INT_MAX: Final = 2**31 - 1
_AS: Final = {"dateTime.iso8601": "string", "bigdecimal": "double"}  # what a YAML file may give a parameter
_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class XmlCall(msgspec.Struct, frozen=True):
    """A call: its method and arguments."""

    method: str
    arguments: list[Value]


class XmlFault(msgspec.Struct, frozen=True):
    """An answer that is a fault."""

    code: Value
    text: str


class XmlResult(msgspec.Struct, frozen=True):
    """An answer that is a value."""

    value: Value


# Encoding


def encode_call(method: str, arguments: tuple[object, ...]) -> bytes:
    """Return the XML of a call. Raises TypeError for a value that XMLRPC does not have."""
    return xmlrpc.client.dumps(tuple(map(_carried, arguments)), methodname=method).encode()


def encode_result(value: object) -> bytes:
    """Return the XML of an answer. Raises TypeError for a value that XMLRPC does not have."""
    return xmlrpc.client.dumps((_carried(value),), methodresponse=True).encode()


def encode_fault(code: int, text: str) -> bytes:
    """Return the XML of a fault."""
    return xmlrpc.client.dumps(xmlrpc.client.Fault(code, _text(text)), methodresponse=True).encode()


def _carried(value: object) -> Any:
    """Return a value as XMLRPC can carry it: integers of more than 32 bits as doubles, and only what XML may have."""
    match value:
        case bool():
            return value
        case int():
            return value if -_INT_MAX - 1 <= value <= _INT_MAX else float(value)
        case str():
            return _text(value)
        case dict():
            return {_text(str(name)): _carried(each) for name, each in value.items()}
        case list() | tuple():
            return [_carried(each) for each in value]
        case _:
            return value


def _text(value: str) -> str:
    return _NOT_XML.sub("\ufffd", value)


# Parsing


class XmlParser:
    """Parses one document, in pieces as they arrive. Raises DecodeError for what is not XMLRPC."""

    def __init__(self) -> None:
        self._depth = 0
        self._values = xmlrpc.client.Unmarshaller(use_builtin_types=True)
        self._expat = expat.ParserCreate()
        self._expat.StartElementHandler = self._start
        self._expat.EndElementHandler = self._end
        self._expat.CharacterDataHandler = self._values.data
        self._expat.StartDoctypeDeclHandler = _refuse_document_type
        self._values.xml(cast("str", None), None)  # expat gives text, not bytes

    def feed(self, data: bytes) -> None:
        """Parse a piece."""
        try:
            self._expat.Parse(data, False)
        except Exception as error:  # noqa: BLE001 - the unmarshaller raises whatever a wrong order of tags leads to
            raise DecodeError(f"not XMLRPC: {error}") from None

    def call(self) -> XmlCall:
        """End the document, which is to be a call."""
        found = self._finish()
        method = self._values.getmethodname()
        if isinstance(found, XmlFault) or not isinstance(method, str):
            raise DecodeError("not a call of XMLRPC")
        return XmlCall(method, found)

    def answer(self) -> XmlResult | XmlFault:
        """End the document, which is to be an answer."""
        found = self._finish()
        if isinstance(found, XmlFault):
            return found
        if self._values.getmethodname() is not None or len(found) != 1:
            raise DecodeError("not an answer of XMLRPC")
        return XmlResult(found[0])

    def _finish(self) -> list[Value] | XmlFault:
        try:
            self._expat.Parse(b"", True)
            return cast("list[Value]", list(self._values.close()))
        except xmlrpc.client.Fault as fault:
            return XmlFault(fault.faultCode, str(fault.faultString))
        except Exception as error:  # noqa: BLE001 - as above
            raise DecodeError(f"not XMLRPC: {error}") from None

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth > DEPTH_MAX:
            raise DecodeError(f"more than {DEPTH_MAX} tags deep")
        self._values.start(tag, attributes)

    def _end(self, tag: str) -> None:
        self._depth -= 1
        self._values.end(_AS.get(tag, tag))


def _refuse_document_type(*_: object) -> None:
    raise DecodeError("a document type")
