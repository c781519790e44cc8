"""Looks at the built site in a browser: `make docs-check`, or `python docs/check_site.py [PAGE...]`.

Each page is opened at the width of a phone and of a desktop, light and dark. It must not scroll sideways, its pictures
and links must lead somewhere, and nothing may come from another server or complain on the console. The button of each
block of commands must copy the commands, and nothing else. `--shots FOLDER` also takes pictures of the pages, for you
to look at. It needs Chromium (Debian's package, or BROWSER with the path of one) and the package playwright.
"""

import argparse
import functools
import http.server
import itertools
import os
import shutil
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urldefrag

from playwright.sync_api import Browser, Page, Request, Response, sync_playwright
from playwright.sync_api import Error as PlaywrightError

SITE = Path(__file__).parents[1] / "site"
WIDTHS = {"phone": (390, 844), "desktop": (1280, 900)}
SCHEMES = ("light", "dark")

_BUTTON = "button[data-clipboard-target], button[data-md-type=copy]"
_FOUND = 10_000  # ms

_LAYOUT = """async () => {
    await Promise.all([...document.images].map(each => each.decode().catch(() => null)))
    const wide = [...document.querySelectorAll('.md-content *')].filter(each => {
        const box = each.getBoundingClientRect()
        if (box.right <= innerWidth + 1 || !box.width) return false
        for (let up = each; up && !up.matches('.md-content'); up = up.parentElement)
            if (getComputedStyle(up).overflowX != 'visible') return false
        return true
    })
    return {
        scrolls: document.documentElement.scrollWidth > innerWidth,
        wide: wide.slice(0, 3).map(each => each.tagName.toLowerCase() + ' ' + each.textContent.trim().slice(0, 60)),
        broken: [...document.images].filter(each => each.complete && !each.naturalWidth).map(each => each.src),
        links: [...document.querySelectorAll('a[href]')].map(each => each.href),
        anchors: [...document.querySelectorAll('[id]')].map(each => each.id),
    }
}"""
_COMMANDS = """block => [...block.querySelectorAll('code')].map(code => {
    const lines = code.textContent.trimEnd().split('\\n'), commands = []
    let goesOn = false
    for (const line of lines) {
        if (line.startsWith('$ ')) commands.push(line.slice(2))
        else if (goesOn) commands.push(line)
        goesOn = (line.startsWith('$ ') || goesOn) && line.endsWith('\\\\')
    }
    return commands.join('\\n')
}).join('\\n')"""


class _Server(http.server.ThreadingHTTPServer):
    """The site, at a free port of this computer."""

    def __init__(self) -> None:
        handler = functools.partial(_Handler, directory=str(SITE))
        super().__init__(("127.0.0.1", 0), handler)
        self.url = f"http://127.0.0.1:{self.server_port}/"


class _Handler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Print nothing."""


class Checker:
    """What is wrong with the pages, and where their links lead."""

    def __init__(self, browser: Browser, url: str, shots: Path | None) -> None:
        self.problems: list[str] = []
        self.copied = 0
        """Blocks of commands whose button was pressed."""
        self._browser = browser
        self._url = url
        self._shots = shots
        self._where = ""
        self._anchors: dict[str, set[str]] = {}
        self._links: dict[str, set[str]] = {}

    def check(self, pages: list[str], scheme: str, width: str) -> None:
        """Look at the pages."""
        size = dict(zip(("width", "height"), WIDTHS[width], strict=True))
        context = self._browser.new_context(color_scheme=scheme, viewport=size)  # type: ignore[arg-type]
        context.grant_permissions(["clipboard-read", "clipboard-write"])
        page = context.new_page()
        self._listen(page)
        for name in pages:
            self._where = f"{name or 'index'} ({width}, {scheme})"
            page.goto(self._url + name, wait_until="load")
            self._look(page, self._url + name)
            if (width, scheme) == ("desktop", "light"):
                self._press_buttons(page)
            if self._shots is not None:
                file = f"{name.strip('/').replace('/', '-') or 'index'}-{width}-{scheme}.png"
                page.screenshot(path=self._shots / file, full_page=width == "phone")
        self._search(page)
        context.close()

    def _report(self, problem: str) -> None:
        self.problems.append(f"{self._where}: {problem}")

    def _listen(self, page: Page) -> None:
        """Report what the page complains of, what it does not get, and what it wants from other servers."""

        def received(response: Response) -> None:
            if not response.url.startswith((self._url, "data:")):
                self._report(f"loads {response.url}")
            elif response.status >= 400:
                self._report(f"{response.status} {response.url}")

        def failed(request: Request) -> None:
            if request.failure != "net::ERR_ABORTED":  # by the next page
                self._report(f"can't load {request.url}: {request.failure}")

        page.on("console", lambda each: self._report(each.text) if each.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: self._report(str(error)))
        page.on("requestfailed", failed)
        page.on("response", received)

    def _look(self, page: Page, address: str) -> None:
        found = page.evaluate(_LAYOUT)
        if found["scrolls"]:
            self._report("scrolls sideways")
        for each in found["wide"]:
            self._report(f"is wider than the page: {each}")
        for each in found["broken"]:
            self._report(f"picture is broken: {each}")
        self._anchors[address] = set(found["anchors"])
        self._links[address] = {each for each in found["links"] if each.startswith(self._url)}

    def _press_buttons(self, page: Page) -> None:
        """Copy each block of commands."""
        for block in page.query_selector_all(".highlight:has(.gp)"):
            wanted = block.evaluate(_COMMANDS).strip()
            page.evaluate("navigator.clipboard.writeText('nothing was copied')")
            block.query_selector(_BUTTON).click(force=True)  # type: ignore[union-attr]
            page.wait_for_timeout(20)  # ms
            copied = page.evaluate("navigator.clipboard.readText()").strip()
            self.copied += 1
            if copied != wanted:
                self._report(f"copies {copied!r} instead of {wanted!r}")

    def _search(self, page: Page) -> None:
        """Search for a word that many pages have."""
        page.keyboard.press("/")
        page.keyboard.type("gateway")
        try:
            page.wait_for_selector(".md-search-result__item", timeout=_FOUND, state="attached")
        except PlaywrightError:
            self._report("the search for `gateway` finds nothing")

    def follow(self) -> Iterator[str]:
        """Links to pages that do not exist, and to anchors that their pages do not have."""
        for page, links in self._links.items():
            for link in sorted(links):
                target, anchor = urldefrag(link)
                file = SITE / unquote(target.removeprefix(self._url))
                if not (file / "index.html" if target.endswith("/") else file).is_file():
                    yield f"{page.removeprefix(self._url)}: no page {link}"
                elif anchor and anchor not in self._anchors.get(target, {anchor}) and not anchor.startswith("__"):
                    yield f"{page.removeprefix(self._url)}: no anchor {link}"


def main() -> None:
    """Check the pages, print what is wrong, and exit with 1 if anything is."""
    parser = argparse.ArgumentParser(description="Look at the built site in a browser.")
    parser.add_argument("pages", nargs="*", help="such as how-to/gateway/; default: all")
    parser.add_argument("--shots", type=Path, help="folder for pictures of the pages")
    arguments = parser.parse_args()
    pages = arguments.pages or [_address(file) for file in sorted(SITE.rglob("index.html"))]
    if arguments.shots is not None:
        arguments.shots.mkdir(parents=True, exist_ok=True)
    checker = _check(pages, arguments.shots)
    problems = [*checker.problems, *checker.follow()]
    sys.stdout.writelines(f"{each}\n" for each in problems)
    sys.stdout.write(f"{len(pages)} pages, {checker.copied} blocks of commands, {len(problems)} problems\n")
    sys.exit(1 if problems else 0)


def _address(file: Path) -> str:
    """The address of a page within the site: "" or "how-to/gateway/"."""
    folder = file.parent.relative_to(SITE).as_posix()
    return "" if folder == "." else f"{folder}/"


def _check(pages: list[str], shots: Path | None) -> Checker:
    path = os.environ.get("BROWSER") or shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        sys.exit("no Chromium: apt install chromium, or give its path in BROWSER")
    with _Server() as server, sync_playwright() as playwright:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        options = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        browser = playwright.chromium.launch(executable_path=path, args=options)
        checker = Checker(browser, server.url, shots)
        for scheme, width in itertools.product(SCHEMES, WIDTHS):
            checker.check(pages, scheme, width)
        browser.close()
        server.shutdown()
        return checker


if __name__ == "__main__":
    main()
