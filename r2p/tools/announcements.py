"""How long a tool listens for announcements: until nothing new comes, or until what did not come is missing.

On ROS it also waits until the types of the topics are made, which have no size before.
"""

import asyncio

import r2p

_SETTLED = 0.3  # seconds without a new announcement, after which an r2p peer has announced everything
_SETTLED_ON_BUS = 0.6  # ... on a bus, where modules announce in turn
_FIRMWARE = 1.5  # seconds in which firmware, which announces one item each half second, is heard at least once
_LOOKED = 1.5  # seconds before something that the user has named is said to be missing: others may be busy
_HEARD_WITHIN = 5.0  # ... where a link has no r2p module yet: in this time firmware sends each announcement
_QUERY_AGAIN = 0.5  # seconds between two queries for it
_SETTLE_MAX = 8.0  # seconds to listen while announcements arrive: a bus of 1 Mbit/s carries 100 of them a second
_SETTLE_POLL = 0.05  # seconds between two counts of what was announced, which take long on a large network


class Announcements:
    """What the other modules have announced to the module of a tool, and whether more is to be expected."""

    def __init__(self, module: r2p.Module) -> None:
        self._module = module

    async def settled(self) -> bool:
        """Wait until no new announcements arrive; False if they still did after the longest time."""
        quiet = _SETTLED_ON_BUS if any(link.has_slots for link in self._module.links) else _SETTLED
        loop = asyncio.get_running_loop()
        start = changed_at = loop.time()
        known = 0
        while (now := loop.time()) - start < _SETTLE_MAX:
            if now - changed_at > quiet and (  # the second part takes long on a large network
                now - start > _FIRMWARE or not (self.expects_more() or self._lacks_nodes())
            ):
                return True
            await asyncio.sleep(_SETTLE_POLL)
            makes_types = any(link.makes_types for link in self._module.links)
            if (count := self._known()) != known or makes_types:
                known, changed_at = count, loop.time()
        return False

    async def heard_all(self) -> None:
        """Return when what has not been announced can be said to be missing; query until then."""
        loop = asyncio.get_running_loop()
        start = queried_at = loop.time()
        await self.settled()
        while (now := loop.time()) - start < (_HEARD_WITHIN if self.expects_more() else _LOOKED):
            if now - queried_at >= _QUERY_AGAIN:
                self._module.query()
                queried_at = now
            await asyncio.sleep(_SETTLE_POLL)

    def _known(self) -> int:
        known = [link.discovery for link in self._module.links]
        return sum(len(each.topics) + len(each.endpoints) + len(each.modules) for each in known)

    def expects_more(self) -> bool:
        """Return whether a link lacks r2p modules, which would answer at once, or has modules without topics.

        Modules have topics, but a gateway announces those of others only after it has looked for other gateways. And
        nodes have modules, but may be announced before these.
        """
        topics = self._module.network.topics().values()
        if any(not each.module for view in topics for each in view.publishers + view.subscribers):
            return True
        complete = self._links_with_r2p() & self._links_with_topics()
        return any(link.up and link.name not in complete for link in self._module.links)

    def _lacks_nodes(self) -> bool:
        """Return whether r2p modules, which announce the nodes of their topics, have only announced a topic so far."""
        modules = self._module.network.modules()
        firmware = {view.link for view in modules if view.instance is None}
        announcing = {view.link for view in modules if view.instance is not None} - firmware
        for view in self._module.network.topics().values():
            for known, links in ((view.publishers, view.published_on), (view.subscribers, view.subscribed_on)):
                if announcing.intersection(links) - {each.link for each in known}:
                    return True
        return False

    def have_firmware(self) -> bool:
        """Return whether there are announcements of modules that do not answer queries."""
        modules = self._module.network.modules()
        return any(view.instance is None for view in modules) or bool(
            self._links_with_topics() - self._links_with_r2p()
        )

    def may_have_firmware(self) -> bool:
        """Return whether firmware has announced something, or may be silent on a link without r2p modules."""
        firmware = {view.link for view in self._module.network.modules() if view.instance is None}
        silent = {link.name for link in self._module.links if link.up and link.passes_probes} - self._links_with_r2p()
        return bool(firmware | silent)

    def _links_with_r2p(self) -> set[str]:
        return {view.link for view in self._module.network.modules() if view.instance is not None}

    def _links_with_topics(self) -> set[str]:
        views = self._module.network.topics().values()
        return {link for view in views for link in view.published_on + view.subscribed_on if link}
