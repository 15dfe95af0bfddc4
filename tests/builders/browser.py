"""A real browser without a screen, driven over its debugging socket: what a page shows, and what keys and clicks do."""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest
from websockets.sync.client import connect

from tests.builders.toy_runs import wait_until

_BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "chrome")
KEYS = {" ": ("Space", 32), "ArrowLeft": ("", 37), "ArrowUp": ("", 38), "ArrowRight": ("", 39), "ArrowDown": ("", 40)}
KEYS |= {"End": ("", 35), "Home": ("", 36)}
_FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--remote-debugging-port=0"),
)


class Tab:
    """One page; `errors` are what its console reported, `requests` the addresses it asked for."""

    def __init__(self, address: str) -> None:
        self._socket = connect(address, max_size=None, ping_interval=None)
        self._numbers = itertools.count(1)
        self.errors: list[str] = []
        self.requests: list[str] = []
        for domain in ("Runtime", "Page", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> Any:
        """Ask the browser for something, and give its answer."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=240.0))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]
            self._hear(answer)

    def _hear(self, event: dict[str, Any]) -> None:
        values = event.get("params", {})
        if event["method"] == "Network.requestWillBeSent":
            self.requests.append(values["request"]["url"])
        elif event["method"] == "Network.webSocketCreated":
            self.requests.append(values["url"])
        elif event["method"] == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(values["exceptionDetails"])[:400])
        elif event["method"] == "Log.entryAdded" and values["entry"]["level"] == "error":
            self.errors.append(f"{values['entry']['text']} {values['entry'].get('url', '')}")
        elif event["method"] == "Runtime.consoleAPICalled" and values["type"] == "error":
            self.errors.append(json.dumps([value.get("value") for value in values["args"]])[:400])

    def run(self, script: str) -> Any:
        """Return what an expression of the page's script comes to."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def press(self, key: str) -> None:
        """Press a key and let it go."""
        code, number = KEYS.get(key, (f"Key{key.upper()}", ord(key.upper()[0])))
        event = {"key": key, "code": code or key, "windowsVirtualKeyCode": number}
        self.call("Input.dispatchKeyEvent", type="rawKeyDown", **event)
        self.call("Input.dispatchKeyEvent", type="keyUp", **event)

    def click(self, text: str) -> None:
        """Click what has this text, such as a button or the head of a folder."""
        element = f"[...document.querySelectorAll('*')].reverse().find((one) => one.textContent === {json.dumps(text)})"
        wait_until(lambda: self.run(f"!!({element})"), f"'{text}' on the page", limit_s=240.0)
        self.run(f"{element}.click()")

    def mouse(self, *points: tuple[float, float]) -> None:
        """Press the left button at the first point, go along the others and let go."""
        (x, y), *rest = points
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, button="left", clickCount=1)
        for x, y in rest:
            self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, button="left", buttons=1)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, button="left", clickCount=1)

    def screenshot(self, path: Path) -> Path:
        """Keep what is seen as a PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
        return path

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


@contextmanager
def open_page(url: str, folder: Path, *, width: int = 1280, height: int = 800) -> Iterator[Tab]:
    """Open a page in headless Chromium, whose pictures are drawn by software; skips where there is none."""
    browser = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        pytest.skip(f"no browser is here: `apt-get install chromium` puts one on the path ({', '.join(_BROWSERS)})")
    profile = folder / f"profile-{width}"
    size = f"--window-size={width},{height}"
    process = subprocess.Popen(
        [browser, *_FLAGS, size, f"--user-data-dir={profile}", "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        port_file = profile / "DevToolsActivePort"
        wait_until(lambda: port_file.is_file() and port_file.read_text().count("\n"), "the browser", limit_s=240.0)
        port = port_file.read_text().split()[0]
        with urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
            page = next(target for target in json.load(answer) if target["type"] == "page")
        tab = Tab(page["webSocketDebuggerUrl"])
        try:
            tab.call(
                "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
            )
            tab.call("Page.navigate", url=url)
            is_loaded = "location.href !== 'about:blank' && document.readyState === 'complete'"
            wait_until(lambda: bool(tab.run(is_loaded)), f"{url} to load", limit_s=240.0)
            yield tab
        finally:
            tab.close()
    finally:
        process.terminate()
        process.wait(timeout=30.0)


def in_browser(page: str, probe: str, folder: Path, *, width: int = 1100) -> Any:
    """Return the answer of a script within a page as `found`, and the page's errors; skips without a browser.

    `probe` is the body of an async function.
    """
    path = folder / "page.html"
    path.write_text(page, encoding="utf-8")
    with open_page(path.as_uri(), folder, width=width, height=900) as tab:
        return {"found": tab.run(f"(async () => {{ {probe} }})()"), "errors": tab.errors}
