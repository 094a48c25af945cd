"""A headless Chromium for tests of pages, by the DevTools protocol over a pipe, without driver and
socket."""

from __future__ import annotations

import base64
import fcntl
import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.conftest import PATIENCE_S

CHROMIUM = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)
_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--hide-scrollbars",
    "--disable-background-networking",
    "--disable-extensions",
    "--force-color-profile=srgb",
    "--remote-debugging-pipe",
)


class Page:
    """One tab. wrong: console errors and uncaught exceptions; asked: addresses that the page
    requested, except itself and embedded data."""

    def __init__(self, read: int, write: int) -> None:
        self._read = read
        self._write = write
        self._numbers = itertools.count(1)
        self._rest = b""
        self._session = ""
        self.wrong: list[str] = []
        self.asked: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a command of the protocol, and return its answer."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            message_in = self._next()
            if message_in.get("id") == number:
                assert "error" not in message_in, (method, message_in)
                return dict(message_in["result"])

    def size(self, width: int, height: int, *, phone: bool = False) -> None:
        """Set the size of the window."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=phone,
        )

    def open(self, path: Path) -> None:
        """Open a file from disk, and wait until its script has ended."""
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=path.resolve().as_uri())
        self.until("document.documentElement?.dataset.ready === 'true'")

    def js(self, expression: str) -> Any:
        """Return the value of an expression in the page, after waiting for a promise."""
        came = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in came, (expression, came["exceptionDetails"])
        return came["result"].get("value")

    def until(self, expression: str) -> None:
        """Wait for an expression to hold."""
        deadline = time.monotonic() + PATIENCE_S
        while not self.js(expression):
            assert time.monotonic() < deadline, f"never: {expression}; {self.wrong}"
            time.sleep(0.02)

    def key(self, key: str, *, shift: bool = False, code: int = 0) -> None:
        """Press and release a key."""
        text = {" ": " ", "Enter": "\r"}.get(key, "")
        for kind in ("keyDown", "keyUp"):
            extra = {"text": text} if text and kind == "keyDown" else {}
            self.call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                modifiers=8 * shift,
                windowsVirtualKeyCode=code,
                **extra,
            )

    def shot(self, path: Path, *, whole: bool = False) -> None:
        """Write a picture of the window, or of the whole page."""
        data = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)[
            "data"
        ]
        path.write_bytes(base64.b64decode(data))

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            more = os.read(self._read, 1 << 20)
            assert more, "Chromium has ended"
            self._rest += more
        line, self._rest = self._rest.split(b"\0", 1)
        message: dict[str, Any] = json.loads(line)
        about = message.get("params", {})
        match message.get("method"):
            case "Runtime.exceptionThrown":
                self.wrong.append(str(about["exceptionDetails"]))
            case "Runtime.consoleAPICalled" if about["type"] in ("error", "assert"):
                self.wrong.append(str(about["args"]))
            case "Log.entryAdded" if about["entry"]["level"] == "error":
                self.wrong.append(str(about["entry"]))
            case "Network.requestWillBeSent" if not about["request"]["url"].startswith(
                ("data:", "blob:", "file:")
            ):
                self.asked.append(about["request"]["url"])
        return message


@contextmanager
def chromium() -> Iterator[Page]:
    """Start a browser with one page, and end it afterwards."""
    assert CHROMIUM is not None
    inward, ours_out = os.pipe()
    ours_in, outward = os.pipe()
    with tempfile.TemporaryDirectory(prefix="chromium-") as folder:

        def wire() -> None:
            """Connect the pipe to 3 and 4, by unused numbers, as either end may be one of the
            two."""
            ends = [fcntl.fcntl(one, fcntl.F_DUPFD, 10) for one in (inward, outward)]
            os.dup2(ends[0], 3)
            os.dup2(ends[1], 4)

        command = [CHROMIUM, *_FLAGS, f"--user-data-dir={folder}", "about:blank"]
        log = (Path(folder) / "stderr").open("wb")
        browser = subprocess.Popen(
            command,
            preexec_fn=wire,
            close_fds=False,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )
        os.close(inward)
        os.close(outward)
        try:
            page = Page(ours_in, ours_out)
            yield page
        finally:
            os.close(ours_out)
            os.close(ours_in)
            browser.terminate()
            browser.wait(PATIENCE_S)
            log.close()
