"""Each URL in the pages is one that r2p accepts."""

import re
from pathlib import Path

import pytest

from r2p import keys
from r2p.transports.url import open_transport
from tests.docs.blocks import ROOT, pages

URL = re.compile(
    r"""(?:(?<=--via\ )|(?<=R2P_VIA=)|(?<=via=")|(?<=via\ =\ ")|(?<=`))
    (?:rtcan|serial|tcp|tcp-listen|zenoh|memory|sim):[^\s`"'|)]+""",
    re.VERBOSE,
)
PLACEHOLDER = re.compile(r"HOST|\.\.\.|:$")
WRONG = {"serial:/dev/ttyUSB0,speed=9600"}  # the page shows its error


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_urls(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    keys.create(Path("robot.key"))  # the one that the pages make
    found = {match[0].rstrip(";,") for match in URL.finditer(page.read_text())}
    for url in sorted(found - WRONG):
        if not PLACEHOLDER.search(url):
            open_transport(url)


def test_they_are_found() -> None:
    text = (ROOT / "docs" / "how-to" / "can.md").read_text()
    assert "rtcan:pcan:PCAN_USBBUS1,bitrate=500000,slots=20" in {match[0] for match in URL.finditer(text)}
