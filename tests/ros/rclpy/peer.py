"""`RclpyPeer`: starts the process of rclpy, asks it, and hands over what its subscribers receive."""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import random
import subprocess
import threading
from collections import deque
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from collections.abc import Callable

_PROGRAM = Path(__file__).with_name("program.py")
LIMIT = 20.0
"""Seconds within which everything is answered: a busy machine needs some."""

Event = dict[str, Any]


class RclpyPeer:
    """A process of rclpy. `ask` waits for its answer; `event` for what it reports, such as messages that arrived."""

    def __init__(self, python: Path, folder: Path) -> None:
        self.domain = random.SystemRandom().randrange(1, 200)
        """The ROS_DOMAIN_ID of this run: other runs on this machine have others."""
        self.environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(self.domain),
            "ROS_LOCALHOST_ONLY": "1",
            "ROS_LOG_DIR": str(folder),
            "PYTHONUNBUFFERED": "1",
        }
        self._folder = folder
        self._command = [str(python), str(_PROGRAM)]
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._answers: dict[int, Future[Any]] = {}
        self._events: deque[Event] = deque()
        self._waiting: list[tuple[Callable[[Event], bool], Future[Event]]] = []

    def __enter__(self) -> Self:
        self._ready: Future[Event] = Future()
        self._waiting.append((lambda event: "ready" in event, self._ready))
        self._errors = (self._folder / "stderr").open("wb")
        self._process = subprocess.Popen(
            self._command, env=self.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self._ready.result(LIMIT)
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(LIMIT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join()
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._errors.close()

    def ask(self, do: str, /, **arguments: Any) -> Any:
        """Return the result of a command. Raises RuntimeError with the text of its error."""
        return self._send(do, arguments).result(LIMIT)

    async def ask_async(self, do: str, /, **arguments: Any) -> Any:
        """The same, while the event loop goes on: for commands that wait for something of it."""
        async with asyncio.timeout(LIMIT):
            return await asyncio.wrap_future(self._send(do, arguments))

    async def event(self, **fields: Any) -> Event:
        """Return the oldest report that has these fields, `topic="/chatter"`, and that was not returned yet."""

        def wanted(event: Event) -> bool:
            return all(event.get(name) == value for name, value in fields.items())

        future: Future[Event] = Future()
        with self._lock:
            found = next((each for each in self._events if wanted(each)), None)
            if found is not None:
                self._events.remove(found)
                return found
            self._waiting.append((wanted, future))
        async with asyncio.timeout(LIMIT):
            return await asyncio.wrap_future(future)

    def forget(self) -> None:
        """Drop the reports that no test waited for."""
        with self._lock:
            self._events.clear()
            self._waiting.clear()

    def _send(self, do: str, arguments: dict[str, Any]) -> Future[Any]:
        number, future = next(self._numbers), Future[Any]()
        self._answers[number] = future
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"id": number, "do": do, **arguments}).encode() + b"\n")
        self._process.stdin.flush()
        return future

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            message = json.loads(line)
            if "id" in message:
                self._answered(message)
            else:
                self._reported(message)
        ended = RuntimeError(f"rclpy has ended: {(self._folder / 'stderr').read_text(errors='replace')[-2000:]}")
        for future in [*self._answers.values(), *(future for _, future in self._waiting)]:
            if not future.done():
                future.set_exception(ended)

    def _answered(self, message: Event) -> None:
        future = self._answers.pop(message["id"])
        if future.cancelled():
            return
        if "error" in message:
            future.set_exception(RuntimeError(message["error"]))
        else:
            future.set_result(message["result"])

    def _reported(self, message: Event) -> None:
        with self._lock:
            self._waiting = [each for each in self._waiting if not each[1].done()]
            for wanted, future in self._waiting:
                if wanted(message) and future.set_running_or_notify_cancel():
                    future.set_result(message)
                    return
            self._events.append(message)
