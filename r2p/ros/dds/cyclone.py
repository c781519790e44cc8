"""Cyclone DDS: a participant, its writers and readers, and the thread that waits for what happens to them.

Endpoints send and receive bytes, serialised already. Cyclone's own classes for types describe them to the peers, whose
descriptions Cyclone DDS then compares; it can't read those of Fast DDS, so nothing with an array would connect. So
topics are made here without a description, as those of ROS's own `rmw_cyclonedds` are, through the C library in the
package cyclonedds; names of types and their hashes are compared all the same.

Nothing of Cyclone DDS calls into Python: a callback would need the interpreter's lock in the threads that receive.
"""

import ctypes
import os
import threading
from collections.abc import Callable
from typing import Any, Final

import msgspec
from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import DDSException, DDSStatus, Entity, GuardCondition, InstanceState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.internal import DDS, dds_c_t, dds_infinity
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.qos import Qos as CycloneQos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from r2p.errors import TransportError
from r2p.ros.dds.graph import DdsEndpoint
from r2p.ros.dds.names import ENCLAVE, checksum_in
from r2p.ros.middleware import Qos

BATCH = 64
"""Messages that are taken from a reader at once."""
_BATCHES = 4  # on their way to the event loop, at most; the rest waits in the readers, as many as they keep
_DISCOVERED_MAX = 10_000  # changes that are looked at in one go: all
_KEPT_MAX = 1000  # messages that a reader without a depth keeps
_FOREVER: Final = (1 << 63) - 1

_library: Any = DDS._dll_handle  # noqa: SLF001 - the library that the package's own classes call


class _Metadata(ctypes.Structure):
    _fields_ = (("data", ctypes.c_void_p), ("size", ctypes.c_uint32))


class _Descriptor(ctypes.Structure):
    """Cyclone's dds_topic_descriptor_t."""

    _fields_ = (
        ("size", ctypes.c_uint32),
        ("align", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("keys_count", ctypes.c_uint32),
        ("type_name", ctypes.c_char_p),
        ("keys", ctypes.c_void_p),
        ("operations_count", ctypes.c_uint32),
        ("operations", ctypes.POINTER(ctypes.c_uint32)),
        ("meta", ctypes.c_char_p),
        ("type_information", _Metadata),
        ("type_mapping", _Metadata),
        ("representation", ctypes.c_uint32),
        ("member_table", ctypes.c_uint32),
    )


class _Vector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_char_p), ("length", ctypes.c_size_t))


_ONE_OCTET = (ctypes.c_uint32 * 3)(1 << 24 | 1 << 16, 0, 0)
"""What Cyclone DDS checks of a payload: it begins with an octet, of any value. Each message of ROS does."""

_create_topic = _library.dds_create_topic
_create_topic.argtypes = [ctypes.c_int32, ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p, ctypes.c_void_p]
_get_type = _library.dds_get_entity_sertype
_get_type.argtypes = [ctypes.c_int32, ctypes.c_void_p]
_make_payload = _library.ddsi_serdata_from_ser_iov
_make_payload.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t]
_make_payload.restype = ctypes.c_void_p
_write = _library.dds_writecdr
_write.argtypes = [ctypes.c_int32, ctypes.c_void_p]
_take = _library.dds_takecdr
_take.argtypes = [ctypes.c_int32, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_void_p, ctypes.c_uint32]
_payload_size = _library.ddsi_serdata_size
_payload_size.argtypes = [ctypes.c_void_p]
_payload_size.restype = ctypes.c_uint32
_read_payload = _library.ddsi_serdata_to_ser
_read_payload.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_size_t, ctypes.c_void_p]
_free_payload = _library.ddsi_serdata_unref
_free_payload.argtypes = [ctypes.c_void_p]
_attach = _library.dds_waitset_attach
_attach.argtypes = [ctypes.c_int32, ctypes.c_int32, ctypes.c_void_p]
_wait = _library.dds_waitset_wait
_wait.argtypes = [ctypes.c_int32, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int64]

_DATA = 2  # kind of a payload: a message, not a key
_ANY_STATE = 0x7F
_HANDLE_MASK = (1 << 64) - 1  # the package reads lists of handles as signed numbers


class DdsSample(msgspec.Struct, frozen=True, gc=False):
    """A received message: its bytes, when it was written (UTC in ns), and the handle of its writer."""

    data: bytes
    stamp: int
    writer: int


class DdsEvents(msgspec.Struct):
    """One batch of the thread's findings, in this order: participants and endpoints, matches, and received messages."""

    found: list[tuple[DdsEndpoint, bool]] = msgspec.field(default_factory=list)
    """Endpoints of others, and whether they write."""
    lost: list[bytes] = msgspec.field(default_factory=list)
    """The GUIDs of endpoints that are gone."""
    lost_participants: list[bytes] = msgspec.field(default_factory=list)
    matches: list[tuple[int, set[int]]] = msgspec.field(default_factory=list)
    """Own endpoints, and the handles of those that they are connected to now."""
    misfits: list[tuple[int, int]] = msgspec.field(default_factory=list)
    """Own endpoints, and the policy of the quality of service which keeps another one away."""
    samples: list[tuple[int, list[DdsSample]]] = msgspec.field(default_factory=list)
    """Own readers, and what they received."""
    errors: list[Exception] = msgspec.field(default_factory=list)
    """Errors of this side."""
    unreadable: int = 0
    """Endpoints of others with what this side can't read, such as texts that are not UTF-8."""


class Participant:
    """A participant in a domain. `report` is called in its thread, with what that has found."""

    def __init__(self, domain: int, interface: str, report: Callable[[DdsEvents], None]) -> None:
        self._report = report
        self._domain = _open_domain(domain, interface)
        self._room = threading.Semaphore(_BATCHES)
        self._ending = self._paused = False
        try:
            self._participant = DomainParticipant(domain, qos=CycloneQos(Policy.Userdata(ENCLAVE)))
            self.gid = self._participant.guid.bytes
            self._waitset = WaitSet(self._participant)
            self._wake = GuardCondition(self._participant)
            topics = (BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription)
            self._builtin = [BuiltinDataReader(self._participant, topic) for topic in topics]
        except DDSException as error:
            _close_domain(domain)
            raise TransportError(f"dds: Cyclone DDS can't join domain {domain}: {error}") from error
        self._number = domain
        self._endpoints: dict[int, DataReader[Any] | DataWriter[Any]] = {}
        self._topics: dict[int, Topic[Any]] = {}
        for entity in (self._wake, *self._builtin):
            self._watch(entity, DDSStatus.DataAvailable if entity is not self._wake else None)
        self._thread = threading.Thread(target=self._run, name=f"dds {domain}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, and leave the domain; the others learn of it at once."""
        self._ending = True
        self._room.release(_BATCHES)
        self._wake.set(True)
        self._thread.join()
        for number in list(self._endpoints):
            self.remove(number)
        for entity in (*self._builtin, self._wake, self._waitset, self._participant):
            _delete(entity)
        _close_domain(self._number)

    def add_writer(self, topic: str, type_name: str, qos: Qos, user_data: bytes) -> int:
        """Return the number of a new writer. Raises DDSException."""
        made = _UntypedTopic(self._participant, topic, type_name)
        writer = DataWriter(self._participant, made, qos=_cyclone_qos(qos, user_data, writes=True))
        return self._add(writer, made, _WRITER_EVENTS)

    def add_reader(self, topic: str, type_name: str, qos: Qos, user_data: bytes) -> int:
        """Return the number of a new reader. Raises DDSException."""
        made = _UntypedTopic(self._participant, topic, type_name)
        reader = DataReader(self._participant, made, qos=_cyclone_qos(qos, user_data, writes=False))
        return self._add(reader, made, _READER_EVENTS)

    def gid_of(self, number: int) -> bytes:
        """Return the GUID of an endpoint."""
        return self._endpoints[number].guid.bytes

    def remove(self, number: int) -> None:
        """End an endpoint."""
        endpoint, topic = self._endpoints.pop(number, None), self._topics.pop(number, None)
        for entity in (endpoint, topic):
            if entity is not None:
                _delete(entity)

    def write(self, number: int, data: bytes) -> bool:
        """Send a message; return whether there was room for it: too much may wait for a slow reader."""
        kind = ctypes.c_void_p()
        _get_type(number, ctypes.byref(kind))
        vector = _Vector(data, len(data))
        payload = _make_payload(kind, _DATA, 1, ctypes.byref(vector), len(data))
        return payload is not None and _write(number, payload) == 0

    def pause(self) -> None:
        """Leave messages in the readers, which keep the last ones."""
        self._paused = True
        self._mask_readers(_READER_EVENTS & ~DDSStatus.DataAvailable)

    def resume(self) -> None:
        """Go on taking messages."""
        self._paused = False
        self._mask_readers(_READER_EVENTS)
        self._wake.set(True)

    def made_room(self) -> None:
        """Note that the event loop has handled what it was given once."""
        self._room.release()

    def _mask_readers(self, mask: int) -> None:
        for endpoint in self._endpoints.values():
            if isinstance(endpoint, DataReader):
                endpoint.set_status_mask(mask)

    def _add(self, endpoint: "DataReader[Any] | DataWriter[Any]", topic: Topic[Any], events: int) -> int:
        number: int = endpoint._ref  # noqa: SLF001 - the handle that the C library knows it by
        self._endpoints[number], self._topics[number] = endpoint, topic
        self._watch(endpoint, events & ~DDSStatus.DataAvailable if self._paused else events)
        return number

    def _watch(self, entity: Entity, events: int | None) -> None:
        if events is not None:
            entity.set_status_mask(events)
        _attach(self._waitset._ref, entity._ref, entity._ref)  # noqa: SLF001

    # In the thread

    def _run(self) -> None:
        ready = (ctypes.c_void_p * BATCH)()
        again: set[int] = set()
        while True:
            count = _wait(self._waitset._ref, ready, BATCH, 0 if again else dds_infinity)  # noqa: SLF001
            if self._ending or count < 0:
                return
            numbers = {int(each) for each in ready[: min(count, BATCH)] if each} | again
            if self._wake._ref in numbers:  # noqa: SLF001
                self._wake.set(False)
                numbers |= self._endpoints.keys()
            events = DdsEvents()
            self._look(numbers, events)
            again = {number for number, samples in events.samples if len(samples) == BATCH}
            if events != _NOTHING:
                self._room.acquire()
                if not self._ending:
                    self._report(events)

    def _look(self, numbers: set[int], events: DdsEvents) -> None:
        for kind, reader in enumerate(self._builtin):
            if reader._ref in numbers:  # noqa: SLF001
                self._discover(reader, kind, events)
        for number in numbers:
            endpoint = self._endpoints.get(number)
            if endpoint is not None:
                try:
                    self._look_at(number, endpoint, events)
                except DDSException:
                    pass  # it was removed meanwhile
                except Exception as error:  # noqa: BLE001 - reported; the thread goes on for all others
                    events.errors.append(error)

    def _look_at(self, number: int, endpoint: "DataReader[Any] | DataWriter[Any]", events: DdsEvents) -> None:
        if isinstance(endpoint, DataWriter):
            changes = endpoint.take_status(_WRITER_EVENTS)
            if changes & DDSStatus.PublicationMatched:
                endpoint.get_publication_matched_status()
                events.matches.append((number, _handles(endpoint.get_matched_subscriptions())))
            if changes & DDSStatus.OfferedIncompatibleQos:
                events.misfits.append((number, endpoint.get_offered_incompatible_qos_status().last_policy_id))
            return
        changes = endpoint.take_status(_READER_EVENTS & ~DDSStatus.DataAvailable)
        if changes & DDSStatus.SubscriptionMatched:
            endpoint.get_subscription_matched_status()
            events.matches.append((number, _handles(endpoint.get_matched_publications())))
        if changes & DDSStatus.RequestedIncompatibleQos:
            events.misfits.append((number, endpoint.get_requested_incompatible_qos_status().last_policy_id))
        samples = [] if self._paused else _take_all(number)
        if samples:
            events.samples.append((number, samples))

    def _discover(self, reader: BuiltinDataReader, kind: int, events: DdsEvents) -> None:
        """Take what has changed, one by one: what can't be read is left out alone."""
        for _ in range(_DISCOVERED_MAX):
            try:
                taken = reader.take(1)
                for each in taken:
                    self._note(each, kind, events)
            except Exception:  # noqa: BLE001 - counted: whatever the package raises for it
                events.unreadable += 1
            else:
                if not taken:
                    return

    def _note(self, each: Any, kind: int, events: DdsEvents) -> None:
        gone = each.sample_info.instance_state != InstanceState.Alive
        if kind == 0:
            if gone:
                events.lost_participants.append(each.key.bytes)
        elif gone:
            events.lost.append(each.key.bytes)
        elif each.participant_key.bytes != self.gid:
            events.found.append((_seen(each), kind == 1))


_READER_EVENTS = DDSStatus.DataAvailable | DDSStatus.SubscriptionMatched | DDSStatus.RequestedIncompatibleQos
_WRITER_EVENTS = DDSStatus.PublicationMatched | DDSStatus.OfferedIncompatibleQos
_NOTHING = DdsEvents()


class _UntypedTopic(Topic[Any]):
    """A topic with the name of its type alone."""

    def __init__(self, participant: DomainParticipant, name: str, type_name: str) -> None:
        descriptor = _Descriptor(1, 1, 0, 0, type_name.encode(), None, len(_ONE_OCTET), _ONE_OCTET, b"")
        made = _create_topic(participant._ref, ctypes.byref(descriptor), name.encode(), None, None)  # noqa: SLF001
        Entity.__init__(self, made)
        self.data_type = object  # nothing is made of it
        self._keepalive_entities = [participant]


def _delete(entity: Entity) -> None:
    """End an entity now; that it is collected later changes nothing more."""
    entity.__del__()


def _take_all(reader: int) -> list[DdsSample]:
    """Return what a reader has, at most a batch; a full one is not the last, which Cyclone DDS does not report."""
    payloads, infos = (ctypes.c_void_p * BATCH)(), (dds_c_t.sample_info * BATCH)()
    found = []
    for number in range(max(0, _take(reader, payloads, BATCH, infos, _ANY_STATE))):
        payload, info = payloads[number], infos[number]
        if info.valid_data:
            size = _payload_size(payload)
            buffer = ctypes.create_string_buffer(size)
            _read_payload(payload, 0, size, buffer)
            found.append(DdsSample(buffer.raw, info.source_timestamp, info.publication_handle))
        _free_payload(payload)
    return found


def _handles(signed: list[int]) -> set[int]:
    return {each & _HANDLE_MASK for each in signed}


def _seen(endpoint: Any) -> DdsEndpoint:
    policies = endpoint.qos
    data = policies[Policy.Userdata].data if Policy.Userdata in policies else b""
    return DdsEndpoint(
        endpoint.key.bytes,
        endpoint.participant_key.bytes,
        endpoint.sample_info.instance_handle,
        endpoint.topic_name,
        endpoint.type_name,
        checksum_in(data),
        _qos(policies),
    )


def _qos(policies: CycloneQos) -> Qos:
    def time(policy: Any, field: str) -> int:
        value = getattr(policies[policy], field) if policy in policies else _FOREVER
        return 0 if value >= _FOREVER else int(value)

    return Qos(
        reliable=isinstance(policies[Policy.Reliability], Policy.Reliability.Reliable),
        transient_local=policies[Policy.Durability] != Policy.Durability.Volatile,
        deadline=time(Policy.Deadline, "deadline"),
        lifespan=time(Policy.Lifespan, "lifespan"),
    )


def _cyclone_qos(qos: Qos, user_data: bytes, *, writes: bool) -> CycloneQos:
    """Return the policies of an endpoint. A writer never blocks: where it has no room, it says so."""
    policies: list[Any] = [
        Policy.Reliability.Reliable(0) if qos.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if qos.transient_local else Policy.Durability.Volatile,
        Policy.History.KeepLast(qos.depth) if qos.depth else Policy.History.KeepAll,
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
        Policy.IgnoreLocal.Participant,  # a link has no use for its own messages
    ]
    if qos.transient_local and writes:
        kept = Policy.History.KeepLast(qos.depth) if qos.depth else Policy.History.KeepAll
        policies.append(Policy.DurabilityService(0, kept, -1, -1, -1))
    if not qos.depth and not writes:
        policies.append(Policy.ResourceLimits(_KEPT_MAX, -1, -1))
    if qos.deadline:
        policies.append(Policy.Deadline(qos.deadline))
    if qos.lifespan and writes:
        policies.append(Policy.Lifespan(qos.lifespan))
    if user_data:
        policies.append(Policy.Userdata(user_data))
    return CycloneQos(*policies)


# Domains: Cyclone DDS has each once in a process


class _OpenDomain(msgspec.Struct):
    domain: Domain
    interface: str
    users: int = 1


_domains: dict[int, _OpenDomain] = {}
_domains_lock = threading.Lock()

_OWN_CONFIG = "CYCLONEDDS_URI"
_CONFIG = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface {}/></Interfaces></General>"
    # By default a participant is announced each 30 s: where the first time is lost, nobody hears it for so long.
    "<Discovery><SPDPInterval>2 s</SPDPInterval></Discovery></Domain></CycloneDDS>"
)


def _open_domain(number: int, interface: str) -> Domain:
    with _domains_lock:
        opened = _domains.get(number)
        if opened is None:
            opened = _domains[number] = _OpenDomain(_make_domain(number, interface), interface, 0)
        elif opened.interface != interface:
            raise TransportError(
                f"dds: a program has one interface for domain {number}, "
                f"and this one uses {opened.interface or 'all'} already: give both links the same"
            )
        opened.users += 1
        return opened.domain


def _make_domain(number: int, interface: str) -> Domain:
    """Return a domain with Cyclone's own configuration, if the user has one, unless an interface is given."""
    chosen = f'name="{interface}" multicast="true"' if interface else 'autodetermine="true"'
    own = "" if interface else os.environ.get(_OWN_CONFIG, "")
    try:
        return Domain(number, own or _CONFIG.format(chosen))
    except DDSException as error:
        raise TransportError(f"dds: Cyclone DDS can't use {interface or 'the network'}: {error}") from error


def _close_domain(number: int) -> None:
    with _domains_lock:
        opened = _domains[number]
        opened.users -= 1
        if not opened.users:
            del _domains[number]
            _delete(opened.domain)
