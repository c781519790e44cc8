"""The flash memory of an emulated module, and the buffer of one page through which its loader writes.

Writing takes time, during which the module's CPU stands still: `Flash.end` is when the last operation ends. What was
being written when the power is cut stays half done.
"""

import msgspec

from r2p.units import SECOND

ERASED = 0xFF
"""The value of each byte after an erasure; writing can only clear bits."""

_NO_PAGE = -1
_HALF_WORD = 2  # bytes that are written at once


class FlashTimes(msgspec.Struct, frozen=True):
    """How long a page takes to be erased, and to be written, in seconds."""

    erase: float = 0.0
    write: float = 0.0


SIMULATED = FlashTimes()
"""The recorded module's: a simulator, whose flash is RAM."""
BOARD = FlashTimes(erase=0.03, write=0.026)
"""An STM32F103's, for a page of 1 KiB."""


class MemoryMap(msgspec.Struct, frozen=True, kw_only=True):
    """Where a module keeps its apps; by default as in the recordings.

    Addresses of parts of an app are multiples of `flash_align`, or `ram_align`; an app whose stack is smaller than
    `least_stack` bytes halts the module. The loader writes whole words of `word` bytes, 1 in the recordings and 2 on an
    STM32F103. It fills them up from the flash and not from its buffer of a page, so where two pieces of one session
    share a word, the part of the first is lost.
    """

    flash_start: int = 0x0800F400
    flash_end: int = 0x08020000
    ram_start: int = 0x20000000
    ram_end: int = 0x20005000
    page: int = 1024
    word: int = 1
    flash_align: int = 16
    ram_align: int = 8
    least_stack: int = 512


class PageWrite(msgspec.Struct, frozen=True):
    """The write of a page: when it starts, when its erasure ends, when all of it ends (ns), and what was there."""

    start: int
    erased: int
    end: int
    at: int
    old: bytes
    new: bytes


class Flash:
    """The part of a module's flash memory that is for apps. It keeps its content without power."""

    def __init__(self, memory: MemoryMap, times: FlashTimes = SIMULATED) -> None:
        self.memory = memory
        self.times = times
        self.data = bytearray([ERASED]) * (memory.flash_end - memory.flash_start)
        """The content, from `memory.flash_start` on."""
        self.worn: dict[int, int] = {}
        """By address: the bits that are worn out, and stay 0 whatever is written."""
        self.erasures = 0
        """Pages erased."""
        self.end = 0
        """When the last operation ends, monotonic ns."""
        self._writes: list[PageWrite] = []

    def begin(self, now: int) -> None:
        """Begin with the operations for one message; those before are over."""
        self._writes.clear()
        self.end = now

    def read(self, address: int, length: int) -> bytes:
        """Read bytes; outside of this memory all are 0."""
        at = address - self.memory.flash_start
        inside = bytes(self.data[max(0, at) : max(0, at + length)])
        return (bytes(max(0, min(-at, length))) + inside).ljust(length, b"\0")

    def write_page(self, address: int, new: bytes) -> bool:
        """Write a page if its content differs, and erase it before if it must. Return whether it can be read back."""
        at = address - self.memory.flash_start
        if at < 0 or at + len(new) > len(self.data):
            return False
        old = bytes(self.data[at : at + len(new)])
        if old == new:
            return True
        dirty = any(before != ERASED for before, after in zip(old, new, strict=True) if before != after)
        start, erased = self.end, self.end + (round(self.times.erase * SECOND) if dirty else 0)
        self.end = erased + round(self.times.write * SECOND)
        self.erasures += dirty
        self.data[at : at + len(new)] = new
        for worn, bits in self.worn.items():
            if address <= worn < address + len(new):
                self.data[worn - self.memory.flash_start] &= ~bits & 0xFF
        self._writes.append(PageWrite(start, erased, self.end, at, old, bytes(self.data[at : at + len(new)])))
        return self._writes[-1].new == new

    def cut_power(self, now: int) -> None:
        """Undo what was not written yet: a page in between is partly erased or partly written."""
        for write in self._writes:
            if now >= write.end:
                continue
            self.data[write.at : write.at + len(write.old)] = _interrupted(write, now)
        self._writes.clear()
        self.end = now


def _interrupted(write: PageWrite, now: int) -> bytes:
    """Return the content of a page whose write was cut at `now`."""
    if now <= write.start:
        return write.old
    size = len(write.old)
    if now < write.erased:
        done = size * (now - write.start) // (write.erased - write.start)
        return bytes([ERASED]) * done + write.old[done:]
    before = bytes([ERASED]) * size if write.erased > write.start else write.old
    done = size * (now - write.erased) // (write.end - write.erased)
    done -= done % _HALF_WORD
    return write.new[:done] + before[done:]


class PageBuffer:
    """The buffer of one page: what is written stays in it until another page is needed, or until `flush`."""

    def __init__(self, flash: Flash) -> None:
        self._flash = flash
        self._size = flash.memory.page
        self._page = _NO_PAGE
        self._data = bytearray()
        self._modified = False

    def begin(self) -> None:
        """Forget the page: the next write reads its page from the flash."""
        self._page = _NO_PAGE
        self._modified = False

    def write(self, address: int, data: bytes) -> bool:
        """Write bytes; a page that gets its last byte goes to the flash. Return whether the flash took all pages."""
        address, data = self._whole_words(address, data)
        while data:
            at = address % self._size
            piece = data[: self._size - at]
            if not self._select(address // self._size):
                return False
            self._data[at : at + len(piece)] = piece
            self._modified = True
            if at + len(piece) == self._size and not self._write_page(self._page):
                return False
            address, data = address + len(piece), data[len(piece) :]
        return True

    def flush(self) -> bool:
        """Write the page to the flash. Return whether the flash took it."""
        modified, self._modified = self._modified, False
        return not modified or self._write_page(self._page)

    def _whole_words(self, address: int, data: bytes) -> tuple[int, bytes]:
        """Widen to whole words, as the loader does: with what the flash holds, not with what the buffer holds."""
        before = address % self._flash.memory.word
        after = -(address + len(data)) % self._flash.memory.word
        if not data or not before + after:
            return address, data
        head = self._flash.read(address - before, before)
        return address - before, head + data + self._flash.read(address + len(data), after)

    def _select(self, page: int) -> bool:
        if page == self._page:
            return True
        previous, self._page = self._page, page
        if self._modified and not self._write_page(previous):
            return False
        self._data = bytearray(self._flash.read(page * self._size, self._size))
        self._modified = False
        return True

    def _write_page(self, page: int) -> bool:
        return self._flash.write_page(page * self._size, bytes(self._data))
