"""The port to SocketCAN on a fake socket; tests/can has real ones."""

from types import SimpleNamespace
from typing import Any

import pytest

from r2p.transports.can import rawsocket
from r2p.transports.can.socketcan import _SocketCanBus
from tests.can.rig import RecordingListener
from tests.faults import once

pytestmark = pytest.mark.virtual_time


async def test_a_frame_that_raises_does_not_stop_the_others_of_its_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    listener = RecordingListener()
    frames = [(rawsocket.DATA | number, b"", 0, 0) for number in range(3)]
    sock: Any = SimpleNamespace(receive=lambda: frames, dropped=0, close=lambda: None)
    monkeypatch.setattr(listener, "on_frame", once(listener.on_frame))
    bus = _SocketCanBus(sock, listener, one_shot=False)
    assert bus._read_batch() == 3
    assert ([frame.id for frame in listener.frames], listener.faults) == ([1, 2], ["internal error: injected"])


async def test_a_timer_that_raises_goes_off_again(monkeypatch: pytest.MonkeyPatch) -> None:
    listener = RecordingListener()
    sock: Any = SimpleNamespace(receive=list, dropped=0, close=lambda: None)
    bus = _SocketCanBus(sock, listener, one_shot=False)
    monkeypatch.setattr(bus._mailboxes, "poll", once(bus._mailboxes.poll))
    bus._poll()
    assert listener.faults == ["internal error: injected"]
    assert bus._timer._armed is not None
    bus._poll()
    assert len(listener.faults) == 1
