"""The answers that a server remembers, so that a repeated request gets the same one and its handler runs once."""

from collections.abc import Iterator

import msgspec

CLIENT_MAX = 64
"""Answers of one client that are remembered, at most: the last ones."""

BYTES_MAX = 1 << 20
"""Bytes of all remembered answers, at most; with one more, the oldest is forgotten."""

_OVERHEAD = 128  # bytes that an answer takes besides its own, about


class _Answer(msgspec.Struct, gc=False):
    data: bytes
    until: int


class RememberedAnswers:
    """Answers by the instance of the caller's module and the number of the call; times are monotonic ns."""

    def __init__(self) -> None:
        self.size = 0
        """Bytes that the answers take."""
        self._answers: dict[tuple[int, int], _Answer] = {}
        """In the order of their entry."""
        self._of_client: dict[int, dict[int, None]] = {}

    def __len__(self) -> int:
        return len(self._answers)

    def __contains__(self, key: tuple[int, int]) -> bool:
        return key in self._answers

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._answers)

    def get(self, instance: int, number: int, now: int, lifetime: int) -> bytes | None:
        """Return the answer to a repeated request, and remember it for `lifetime` (ns) more: its caller still waits."""
        answer = self._answers.get((instance, number))
        if answer is None:
            return None
        if answer.until < now:
            self._forget((instance, number))
            return None
        answer.until = max(answer.until, now + lifetime)
        return answer.data

    def put(self, instance: int, number: int, data: bytes, now: int, lifetime: int) -> None:
        """Remember an answer for `lifetime` (ns), as long as there is room."""
        answers, key = self._answers, (instance, number)
        if key in answers:
            self._forget(key)
        answers[key] = _Answer(data, now + lifetime)
        numbers = self._of_client.get(instance)
        if numbers is None:
            numbers = self._of_client[instance] = {}
        numbers[number] = None
        self.size += len(data) + _OVERHEAD
        if len(numbers) > CLIENT_MAX:
            self._forget((instance, next(iter(numbers))))
        while self.size > BYTES_MAX:
            self._forget(next(iter(answers)))

    def _forget(self, key: tuple[int, int]) -> None:
        instance, number = key
        self.size -= len(self._answers.pop(key).data) + _OVERHEAD
        numbers = self._of_client[instance]
        del numbers[number]
        if not numbers:
            del self._of_client[instance]
