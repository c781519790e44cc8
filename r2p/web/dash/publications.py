"""What a page publishes, and the services that it calls."""

import asyncio
from typing import Any

from r2p.codecs.services import REQUESTS, RESPONSES
from r2p.errors import Error, WebError
from r2p.messages import Message
from r2p.messages.values import from_plain, to_plain
from r2p.runtime.publishers.non_real_time import Publisher
from r2p.services.definition import body_of
from r2p.web.client import WebClient
from r2p.web.dash import protocol
from r2p.web.dash.feeds import TopicFeeds

PUBLISHERS_MAX = 16
"""Topics that one page publishes."""
RATE_MAX = 200.0
"""Messages per second of one topic that a page publishes."""
TIMEOUT_MAX = 300.0
"""Seconds that a page waits for the answer of a service."""

_SUBSCRIBER = 1.0  # seconds to wait for a subscriber, before the first message of a topic
_LOOK = 0.02  # seconds between two looks for one
_NEWS = 1.0  # seconds between two reports of what was published


class Publications:
    """The topics that one page publishes. They end with it."""

    def __init__(self, feeds: TopicFeeds, client: WebClient) -> None:
        self._feeds = feeds
        self._client = client
        self._publishers: dict[str, Publisher[Any]] = {}
        self._repeating: dict[str, asyncio.Task[None]] = {}

    async def publish(self, request: protocol.Publish) -> object:
        """Publish a message, and begin to repeat it at its rate; return how many subscribers it has."""
        if not 0 <= request.rate <= RATE_MAX:
            raise WebError(f"a page publishes at most {RATE_MAX:g} messages per second, not {request.rate:g}")
        publisher, message = await self._prepare(request)
        await self._wait_for_subscriber(publisher)
        while request.topic in self._repeating:
            await self._stop(request.topic)
        if request.rate:
            task = asyncio.create_task(self._repeat(request.topic, publisher, message, request.rate))
            self._repeating[request.topic] = task
        await publisher.publish(message)
        return {"subscribers": publisher.subscribers}

    async def stop(self, request: protocol.StopPublishing) -> None:
        """Publish a topic no more at a rate."""
        await self._stop(request.topic)

    async def close(self) -> None:
        """End all that the page publishes."""
        for topic in [*self._repeating]:
            await self._stop(topic)
        for publisher in self._publishers.values():
            publisher.close()

    async def _prepare(self, request: protocol.Publish) -> tuple[Publisher[Any], Message]:
        """Return the publisher of a topic, and the message. Raises Error for a type or a value that does not fit."""
        publisher = self._publishers.get(request.topic)
        if publisher is None and len(self._publishers) >= PUBLISHERS_MAX:
            raise WebError(f"a page publishes at most {PUBLISHERS_MAX} topics: reload it to begin anew")
        cls = await self._feeds.find_type(request.topic, request.type)
        message = from_plain(cls, request.value)
        publisher = self._publishers.get(request.topic)
        if publisher is None:
            publisher = self._publishers[request.topic] = self._feeds.node.advertise(request.topic, cls)
        return publisher, message

    async def _wait_for_subscriber(self, publisher: Publisher[Any]) -> None:
        """Wait a little before the first message: subscribers that are there have to learn of the publisher first."""
        loop = asyncio.get_running_loop()
        end = loop.time() + _SUBSCRIBER
        while not (publisher.sent or publisher.subscribers) and loop.time() < end:  # noqa: ASYNC110 - there is no event
            await asyncio.sleep(_LOOK)

    async def _stop(self, topic: str) -> None:
        task = self._repeating.pop(topic, None)
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    async def _repeat(self, topic: str, publisher: Publisher[Any], message: Message, rate: float) -> None:
        """Publish a message over and over, and report it to the page once a second, and at the end."""
        loop, begin = asyncio.get_running_loop(), publisher.sent
        report_at = loop.time() + _NEWS
        error = ""
        try:
            async for _ in self._feeds.node.every(1 / rate):
                await publisher.publish(message)
                if loop.time() >= report_at:
                    report_at = loop.time() + _NEWS
                    self._report(topic, publisher.sent - begin, running=True)
        except Error as problem:
            error = str(problem)
        finally:
            self._report(topic, publisher.sent - begin, running=False, error=error)

    def _report(self, topic: str, sent: int, *, running: bool, error: str = "") -> None:
        news: dict[str, Any] = {"op": "published", "topic": topic, "sent": sent, "running": running}
        if error:
            news["error"] = error
        self._client.send(protocol.encode(news).decode(), f"published {topic}")


async def service_types(feeds: TopicFeeds, service: str) -> tuple[type[Message], type[Message]]:
    """Return the types of a service's request and response. Raises WebError."""
    found = [
        body_of(await feeds.find_type(service + end), field)
        for end, field in ((REQUESTS, "request"), (RESPONSES, "response"))
    ]
    request, response = found
    if request is None or response is None:
        raise WebError(f"{service[:100]} is not a service: its topics have other types")
    return request, response


async def call_service(feeds: TopicFeeds, request: protocol.CallService) -> object:
    """Call a service, and return its response as plain values. Raises Error, and TimeoutError without an answer."""
    if not 0 < request.timeout <= TIMEOUT_MAX:
        raise WebError(f"the time-out of a call is at most {TIMEOUT_MAX:g} s, and more than 0, not {request.timeout:g}")
    request_type, response_type = await service_types(feeds, request.service)
    message = from_plain(request_type, request.value)
    client = feeds.node.client(request.service, request_type, response_type)
    try:
        await client.ready(request.timeout)
        return to_plain(await client.call(message, timeout=request.timeout))
    finally:
        client.close()
