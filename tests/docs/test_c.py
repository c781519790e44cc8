"""The C in the documentation: a compiler takes it, and it does what r2p expects of firmware."""

from __future__ import annotations

import ctypes
import hashlib
import hmac
import shutil
import subprocess
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.codecs import management
from tests.docs.blocks import ROOT, of_page
from tests.services.common import outcome
from tests.services.test_firmware import ServerProgram, on

if TYPE_CHECKING:
    from pathlib import Path

CC = shutil.which("cc")
CALLBACK = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t, ctypes.POINTER(ctypes.c_uint8)
)
PROLOGUE = """
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
void (*hmac_sha256)(const uint8_t *key, size_t length, const uint8_t *data, size_t size, uint8_t tag[32]);
"""

pytestmark = pytest.mark.skipif(CC is None, reason="needs a C compiler: Debian's gcc")


@pytest.fixture
def library(tmp_path: Path) -> ctypes.CDLL:
    blocks = [each.text for each in of_page(ROOT / "docs/PROTOCOL.md") if "compiled" in each.notes]
    (tmp_path / "firmware.c").write_text("\n".join([PROLOGUE, *blocks]))
    command = [str(CC), "-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "firmware.c"]
    subprocess.run([*command, "-o", "firmware.so"], check=True, cwd=tmp_path)
    return ctypes.CDLL(str(tmp_path / "firmware.so"))


class Add(r2p.Service):
    class Request(r2p.Message):
        a: r2p.u32 = 0
        b: r2p.u32 = 0

    class Response(r2p.Message):
        total: r2p.u32 = 0


class CompiledServer(ServerProgram):
    """The server of the page, on a board that emulates everything else."""

    publishes, subscribes = ("add_r", 16), ("add_q", 20)

    def __init__(self, library: ctypes.CDLL) -> None:
        super().__init__()
        self.answer = library.add_answer
        self.answer.restype = ctypes.c_bool
        self.received: list[bytes] = []

    def receive(self, data: bytes) -> None:
        assert len(data) == 20
        out = ctypes.create_string_buffer(16)
        if self.answer(data, out):
            self.received.append(data)
            if len(self.received) != 2:  # the answer is lost
                self.publish(out.raw)


@pytest.mark.virtual_time
@pytest.mark.parametrize("kind", ["line", "bus"])
async def test_the_server_answers_calls(library: ctypes.CDLL, kind: str) -> None:
    program = CompiledServer(library)
    async with on(kind, program) as node:
        calls = node.client("add", Add)
        await calls.ready(30)
        assert await calls.call(Add.Request(a=1, b=2), timeout=5.0) == Add.Response(total=3)
        assert await calls.call(Add.Request(a=1 << 31, b=7), timeout=5.0) == Add.Response(total=(1 << 31) + 7)
        assert program.received[1] == program.received[2]  # asked again, and answered as before
        assert isinstance(await outcome(calls.call(Add.Request(), timeout=5.0, server="OTHER")), r2p.NoServer)


def test_the_server_ignores_what_is_not_for_it(library: ctypes.CDLL) -> None:
    answer, out = library.add_answer, ctypes.create_string_buffer(16)
    answer.restype = ctypes.c_bool
    header = bytes.fromhex("78563412 0201 00 01 00000000")
    assert answer(header + bytes(8), out)
    assert out.raw == bytes.fromhex("78563412 0201 02 01 00000000") + bytes(4)
    assert not answer(header[:6] + b"\2" + header[7:] + bytes(8), out)
    assert not answer(header[:7] + b"\2" + header[8:] + bytes(8), out)
    assert not answer(header[:8] + b"\1\0\0\0" + bytes(8), out)
    cancel = bytes.fromhex("78563412 0301 01 01 00000000")
    assert answer(cancel + bytes(8), out)
    assert out.raw == bytes.fromhex("78563412 0301 03 01 00000000") + bytes(4)


def test_the_seal_is_that_of_r2p(library: ctypes.CDLL) -> None:
    def hmac_sha256(key: int, length: int, data: int, size: int, tag: ctypes._Pointer[ctypes.c_uint8]) -> None:
        made = hmac.digest(ctypes.string_at(key, length), ctypes.string_at(data, size), hashlib.sha256)
        ctypes.memmove(tag, made, 32)

    callback = CALLBACK(hmac_sha256)  # kept, as long as the library may call it
    ctypes.c_void_p.in_dll(library, "hmac_sha256").value = ctypes.cast(callback, ctypes.c_void_p).value
    seal = ctypes.create_string_buffer(32)
    seal.raw = bytes(1) + bytes.fromhex("78563412 09000000 08000000") + bytes(19)
    stop = management.encode(management.Stop("IMU1"))
    library.seal(seal, bytes(32), ctypes.c_size_t(32), stop)
    expected = "01 78563412 09000000 08000000 B32E 2810D2F541E71F2CE5ACFFEE4C8663CA 5A"  # as on the page
    assert seal.raw == bytes.fromhex(expected)
