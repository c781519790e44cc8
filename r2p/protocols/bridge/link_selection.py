"""Choose which of its links a module uses, so that it sends and receives nothing twice.

Where gateways join the networks of two links, messages sent by both arrive twice: so only the first link is used, and
the others stand by. A module learns of gateways by their BRIDGE, of two links to one network by its own messages, and
of loops through firmware by probes. It may use several links with gateways only while these consent: each has
acknowledged its LEAF within a lease, so it waits for this module before it joins their meshes.

`CandidateLink` is one link, `LinkChoice` chooses among those that can carry a topic, `LinkSelection` does so for a
whole module.
"""

from collections import Counter

import msgspec

from r2p.codecs.management import LEAF_ACKS, Bridge, Leaf, leaf_port
from r2p.codecs.probes import PORT_MODULUS
from r2p.protocols.bridge.mesh import PortId
from r2p.protocols.bridge.ports import (
    APART,
    DEAD,
    LEASE,
    LISTEN,
    SETTLE,
    TICK,
    TICK_LISTENING,
    Neighbour,
    SentMessages,
    is_late,
    pack_acks,
)
from r2p.units import LONG_AGO, NEVER, SECOND

TWIN_MEMORY = 7 * SECOND
"""Ns after which two links that led to one network no longer count as doing so, unless it shows again."""

_SUSPICION = SECOND  # ns in which it shows by which link messages of this module came back
_LINGER = SECOND  # ns for which LEAF goes on after its use has ended: gateways may be waiting for an answer


class CandidateLink(msgspec.Struct, eq=False):
    """A link that is up. Before `known_at` (monotonic ns) there may be gateways that were not heard yet.

    `twins` are other links to the same network, by number, and when that last showed; `loops` those that lead to it
    through a gateway of firmware. LEAF is sent soon if there is `something_new`, and once when it `asks` whose messages
    came in; `suspected_at`: when that was asked first. `echoes`: it returns own messages. `remote` is the instance
    of the module at the other end of a line.
    """

    number: int
    known_at: int
    gateways: dict[PortId, Neighbour] = {}
    twins: dict[int, int] = {}
    loops: dict[int, int] = {}
    sent_at: int = LONG_AGO
    something_new: bool = False
    asks: bool = False
    suspected_at: int = NEVER
    echoes: bool = False
    remote: int | None = None

    @property
    def leads_to(self) -> set[tuple[str, int]]:
        """Return what two links that lead to the same modules have in common."""
        places = {("network", number) for number in (self.number, *self.twins, *self.loops)}
        places |= {("mesh", each.root) for each in self.gateways.values()}
        return places if self.remote is None else places | {("module", self.remote)}

    @property
    def consent_until(self) -> int:
        """Return until when all gateways there have consented to use the link together with others."""
        return min((each.acked_at for each in self.gateways.values()), default=NEVER) + LEASE

    def is_contested(self, now: int) -> bool:
        """Return whether gateways may join the link's network to others."""
        return bool(self.gateways) or now < self.known_at

    def is_busy(self, now: int) -> bool:
        """Return whether time may change what is known of the link's network, or there is something to send."""
        return bool(self.gateways or self.twins or self.loops) or self.asks or now < self.known_at


class LinkChoice:
    """The links to use for topics that all links but those in `without` can carry."""

    def __init__(self, without: frozenset[int]) -> None:
        self.without = without
        self.used: frozenset[int] = frozenset()
        self.consent_until = NEVER
        """End of the gateways' consent to use more than one contested link."""
        self._contested: frozenset[int] = frozenset()
        self._barred: dict[int, int] = {}  # number -> until when another link, or a lack of consent, barred its use
        self._closed_at = LONG_AGO  # when a contested link was given up

    def forget(self, number: int) -> None:
        """Forget a link that is down."""
        self._barred.pop(number, None)

    def add(self, number: int) -> bool:
        """Use a new link at once if no other one leads to its network; return whether that changes anything."""
        if number in self.without or number in self.used:
            return False
        self.used |= {number}
        return True

    def remove(self, number: int) -> bool:
        """Give up such a link when it is down; return whether that changes anything."""
        if number not in self.used:
            return False
        self.used -= {number}
        return True

    def choose(self, now: int, links: list[CandidateLink]) -> bool:
        """Choose among the links that are up (in order); return whether more than one is contested."""
        links = [link for link in links if link.number not in self.without]
        candidates, barred = self._candidates(now, links)
        contested = [link for link in candidates if link.is_contested(now)]
        self.consent_until = min(link.consent_until for link in contested) if len(contested) > 1 else NEVER
        if now >= self.consent_until:  # one contested link needs no consent: keep the one that is in use
            self.consent_until = NEVER
            first = next((link for link in contested if link.number in self.used), contested[0])
            barred += [link for link in contested if link is not first]
            candidates = [link for link in candidates if link not in barred]
        self._bar(now, {link.number for link in barred})
        used = frozenset(link.number for link in candidates if self._may_begin(now, link))
        if (self.used - used) & self._contested:  # what it sent may still be on its way: others begin after SETTLE
            self._closed_at = now
        self.used = used
        self._contested = used & {link.number for link in links if link.is_contested(now)}
        return len(contested) > 1

    def next_deadline(self, now: int) -> int:
        """Return when to choose again, if nothing else happens."""
        dues = [self.consent_until, self._closed_at + SETTLE, *(at + SETTLE for at in self._barred.values())]
        return min((due for due in dues if due > now), default=NEVER)

    def _bar(self, now: int, numbers: set[int]) -> None:
        ended = {number: now for number, at in self._barred.items() if at == NEVER and number not in numbers}
        self._barred |= ended | dict.fromkeys(numbers, NEVER)

    def _candidates(self, now: int, links: list[CandidateLink]) -> tuple[list[CandidateLink], list[CandidateLink]]:
        """Return links that may be used together, if the gateways consent, and those that have to stand by for them."""
        settled = any(link.is_contested(now) and (now >= link.known_at or link.number in self.used) for link in links)
        candidates: list[CandidateLink] = []
        barred: list[CandidateLink] = []
        reached: set[tuple[str, int]] = set()
        contested: list[CandidateLink] = []
        for link in links:
            places = link.leads_to
            if not places.isdisjoint(reached):
                barred.append(link)
                continue
            if link.is_contested(now):
                # A link that is not fully known is used alone, and only while no other one is known better.
                if now < link.known_at:
                    fits = not contested and (link.number in self.used or not settled)
                else:
                    fits = all(now >= other.known_at for other in contested)
                if not fits:
                    continue
                contested.append(link)
            reached |= places
            candidates.append(link)
        return candidates, barred

    def _may_begin(self, now: int, link: CandidateLink) -> bool:
        """Return whether messages sent by the link that was used before have arrived by now."""
        if link.number in self.used:
            return True
        since = self._barred.get(link.number, LONG_AGO)
        if link.is_contested(now):
            since = max(since, self._closed_at)
        return now >= since + SETTLE


class LinkSelection:
    """The links of one module; links have numbers, in the order in which they are preferred.

    Every method takes `now` (monotonic ns). `pop_messages` returns messages to send, as number and LEAF (None: a probe,
    which gateways of firmware pass on); `changes` counts changes of the choice.
    """

    def __init__(self, instance: int) -> None:
        self.by_number: dict[int, CandidateLink] = {}
        self.changes = 0
        self.consent_until = NEVER
        """The instant (monotonic ns) at which a choice ends by itself: it must not be used after that."""
        self._instance = instance or 1
        self._choices: dict[frozenset[int], LinkChoice] = {}
        self._needed_at = LONG_AGO
        self._sent = SentMessages(self._instance)
        self._updated_at = 0
        self._messages: list[tuple[int, Leaf | None]] = []
        self._busy: list[CandidateLink] = []
        """Links with received messages, or that expect some: all others need no timer."""
        self._links_to: Counter[int] = Counter()
        """Number of links that lead to each module."""

    @property
    def needs_consent(self) -> bool:
        """Return whether the consent of gateways, until `consent_until`, allows more links than without."""
        return self.consent_until < NEVER

    @property
    def may_announce(self) -> bool:
        """Return whether gateways are to know of this module."""
        return self._updated_at < self._needed_at + _LINGER

    # Links

    def open(self, now: int, number: int, *, lone: bool) -> None:
        """Add a link that came up; `lone`: it has only one other end."""
        self.close(now, number)
        link = self.by_number[number] = CandidateLink(number, now if lone else now + LISTEN)
        if not (lone and self._stands_alone(link)):
            self._update(now)
            return
        for choice in self._choices.values():
            self.changes += choice.add(number)

    def close(self, now: int, number: int) -> None:
        """Remove a link that went down."""
        link = self.by_number.get(number)
        if link is None:
            return
        stands_alone = self._stands_alone(link)
        del self.by_number[number]
        if link.remote is not None:
            self._forget_remote(link.remote)
        for choice in self._choices.values():
            choice.forget(number)
            if stands_alone:
                self.changes += choice.remove(number)
        if not stands_alone:
            self._update(now)

    def forget(self, number: int) -> None:
        """Forget a link that is removed for good."""
        self._choices = {key: choice for key, choice in self._choices.items() if number not in key}

    # Consequences

    def used(self, now: int, without: frozenset[int]) -> frozenset[int]:
        """The links to use for topics that all can carry but those in `without`."""
        choice = self._choices.get(without)
        if choice is None:
            choice = self._choices[without] = LinkChoice(without)
            self._update(now)
        return choice.used

    def is_twin(self, number: int) -> bool:
        """Return whether the link leads to the network of a preferred link."""
        link = self.by_number.get(number)
        return link is not None and any(other < number for other in link.twins)

    def stands_by_for(self, number: int) -> int | None:
        """Return the preferred link to the same modules."""
        link = self.by_number.get(number)
        if link is None:
            return None
        others = [each for each in self.by_number.values() if not each.leads_to.isdisjoint(link.leads_to)]
        return min((each.number for each in others if each.number < number), default=None)

    def pop_messages(self) -> list[tuple[int, Leaf | None]]:
        """Return and forget the messages to send."""
        messages, self._messages = self._messages, []
        return messages

    def poll(self, now: int) -> None:
        """Forget silent gateways, and send due messages."""
        self._update(now)
        for link in self._busy:
            if self._due(link) <= now:
                self._send_leaf(now, link)

    def next_deadline(self) -> int | None:
        """Return when to call `poll`."""
        now = self._updated_at
        dues = [choice.next_deadline(now) for choice in self._choices.values()]
        if len(self.by_number) > 1:
            for link in self._busy:
                dues.append(self._due(link))
                dues += [each.heard_at + DEAD for each in link.gateways.values()]
                dues += [at + TWIN_MEMORY for at in (*link.twins.values(), *link.loops.values())]
                dues += [link.known_at] if now < link.known_at else []
        due = min(dues, default=NEVER)
        return due if due < NEVER // 2 else None  # half: some dues are a little less or more than NEVER

    # Received

    def receive_bridge(self, now: int, number: int, message: Bridge) -> None:
        """Handle a BRIDGE: there is a gateway on the link's network."""
        link = self.by_number.get(number)
        if link is None or not message.gateway:
            return
        sender = (message.gateway, message.port)
        known = link.gateways.get(sender)
        if known is not None and is_late(message.count, known.count):
            return
        link.something_new |= known is None or known.root != message.root
        acked_at = self._sent.acked_at(message.acks)
        if known is not None:
            acked_at = max(acked_at, known.acked_at)
        link.gateways = link.gateways | {sender: Neighbour(now, message.count, acked_at, root=message.root)}
        self._update(now)

    def receive_leaf(self, now: int, number: int, message: Leaf) -> None:
        """Handle a LEAF of this module that came back."""
        link = self.by_number.get(number)
        if link is None:
            return
        link.echoes = message.port == leaf_port(number)
        for other in self.by_number:
            if other != number and leaf_port(other) == message.port:
                link.twins = link.twins | {other: now}
        self._update(now)

    def receive_probe(self, now: int, number: int, port: int) -> None:
        """Handle a probe of this module that came back; it was sent on a link with this number modulo PORT_MODULUS."""
        link = self.by_number.get(number)
        if link is not None:
            others = [other for other in self.by_number if other != number and other % PORT_MODULUS == port]
            link.loops = link.loops | dict.fromkeys(others, now)
            self._update(now)

    def receive_own(self, now: int, number: int) -> bool:
        """Handle a message of this module, or of another one of its name, from this link.

        True: another link may have sent it, which LEAF or a probe will show. False: it is an echo, or a namesake.
        """
        link = self.by_number.get(number)
        if link is None or len(self.by_number) < 2 or link.echoes:
            return False
        if link.twins or link.loops or link.is_contested(now):
            link.suspected_at = NEVER
        else:
            link.suspected_at = min(link.suspected_at, now)
        for each in self.by_number.values():  # any of them may have sent it: what they send now shows which
            each.asks = True
        self._update(now)
        return now < link.suspected_at + _SUSPICION

    def set_remote(self, now: int, number: int, instance: int | None) -> None:
        """Enter which module is at the other end of a line. Where two lines lead to one module, the one of the two that
        has the lower instance gives up one of them; the other just sees that nothing is subscribed there now.
        """
        link = self.by_number.get(number)
        if instance is not None and instance < self._instance:
            instance = None  # the other end chooses; if both did, each might give up the link that the other one keeps
        if link is None or link.remote == instance:
            return
        stood_alone = self._stands_alone(link)
        if link.remote is not None:
            self._forget_remote(link.remote)
        link.remote = instance
        if instance is not None:
            self._links_to[instance] += 1
        if not (stood_alone and self._stands_alone(link)):
            self._update(now)

    def _update(self, now: int) -> None:
        self._updated_at = now
        for link in self.by_number.values():
            self._expire(now, link)
        links = [link for _, link in sorted(self.by_number.items())]
        self._busy = [link for link in links if link.is_busy(now)]
        for choice in self._choices.values():
            before = choice.used
            if choice.choose(now, links):
                self._needed_at = now
            self.changes += choice.used != before
        self.consent_until = min((choice.consent_until for choice in self._choices.values()), default=NEVER)

    def _forget_remote(self, instance: int) -> None:
        self._links_to[instance] -= 1
        if not self._links_to[instance]:
            del self._links_to[instance]

    def _stands_alone(self, link: CandidateLink) -> bool:
        """Return whether other links don't depend on this one: one of a thousand clients costs no more."""
        alone = link.remote is None or self._links_to[link.remote] == 1
        return alone and link not in self._busy and not any(each.twins or each.loops for each in self._busy)

    def _expire(self, now: int, link: CandidateLink) -> None:
        """Listen again before gateways that were silent for so long count as gone."""
        if any(now - each.heard_at >= DEAD for each in link.gateways.values()):
            link.gateways = {sender: each for sender, each in link.gateways.items() if now - each.heard_at < DEAD}
            if not link.gateways:
                link.known_at = now + LISTEN
        if link.twins or link.loops:
            link.twins, link.loops = self._fresh(now, link.twins), self._fresh(now, link.loops)

    def _fresh(self, now: int, others: dict[int, int]) -> dict[int, int]:
        return {other: at for other, at in others.items() if other in self.by_number and now - at < TWIN_MEMORY}

    def _due(self, link: CandidateLink) -> int:
        """Return when to send LEAF."""
        now = self._updated_at
        if now < link.known_at and sum(each.is_contested(now) for each in self._busy) > 1:
            tick = TICK_LISTENING
        elif link.gateways and self.may_announce:
            tick = TICK
        elif link.asks:
            return now
        else:
            return NEVER
        return link.sent_at + (APART if link.something_new else tick)

    def _send_leaf(self, now: int, link: CandidateLink) -> None:
        count = self._sent.next_number(now)
        for packed in pack_acks(link.gateways, LEAF_ACKS):
            self._messages.append((link.number, Leaf(self._instance, leaf_port(link.number), count, packed)))
        if link.asks:
            self._messages.append((link.number, None))
        link.sent_at = now
        link.something_new = link.asks = False
