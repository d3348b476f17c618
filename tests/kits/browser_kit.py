"""A real browser, driven over its DevTools protocol: nothing but Chromium and a WebSocket."""

from __future__ import annotations

import json
import shutil
import subprocess
from base64 import b64decode
from importlib import resources
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx
import pytest
from wait_kit import WITHIN, found
from websockets.sync.client import ClientConnection, connect

NAMES = ("chromium", "chromium-browser", "google-chrome")
# A display of 10 frames a second, as a slow machine has: without one the page draws 60, which takes
# half a processor of the machine that the tests share.
SLOW_DISPLAY = """
window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 100);
window.cancelAnimationFrame = clearTimeout;
"""
# What a key is to a browser besides its name: number, and the text that it types.
KEYS = {"Tab": (9, ""), "Enter": (13, "\r"), "Escape": (27, ""), "ArrowDown": (40, "")}


class Browser:
    """One page of headless Chromium; the test skips where there is none."""

    def __init__(self, profile: Path) -> None:
        program = next((path for name in NAMES if (path := shutil.which(name))), None)
        if program is None:
            pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed")
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0"]
        more = ["--remote-allow-origins=*", f"--user-data-dir={profile}", "about:blank"]
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen([program, *flags, *more], stdout=quiet, stderr=quiet)
        told = profile / "DevToolsActivePort"
        found(lambda: told.exists() and "\n" in told.read_text(), WITHIN)
        port = told.read_text().split("\n")[0]
        pages = httpx.get(f"http://127.0.0.1:{port}/json", timeout=WITHIN).json()
        url = next(p["webSocketDebuggerUrl"] for p in pages if p["type"] == "page")
        # Between two tests nobody reads: pings would find no answer behind what the page has said.
        self._socket: ClientConnection = connect(
            url, max_size=None, open_timeout=WITHIN, ping_interval=None
        ).__enter__()
        self._asked = 0
        self.errors: list[str] = []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.call("Page.addScriptToEvaluateOnNewDocument", source=SLOW_DISPLAY)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Ask the browser; what goes wrong in the page meanwhile is kept in `errors`."""
        self._asked += 1
        request = {"id": self._asked, "method": method, "params": parameters}
        self._socket.send(json.dumps(request))
        while True:
            answer = json.loads(self._socket.recv(timeout=WITHIN))
            if answer.get("id") == self._asked:
                assert "error" not in answer, answer
                return answer["result"]
            if answer.get("method") == "Runtime.exceptionThrown":
                self.errors.append(str(answer["params"]["exceptionDetails"]))
            entry = answer.get("params", {}).get("entry", {})
            # That a service is gone, or answers with a refusal, is no fault of the page.
            if entry.get("level") == "error" and entry.get("source") != "network":
                self.errors.append(entry["text"])

    def go(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def value(self, expression: str) -> Any:
        """What JavaScript says."""
        said = self._evaluated(expression)
        assert "exceptionDetails" not in said, said["exceptionDetails"]
        return said["result"].get("value")

    def _evaluated(self, expression: str) -> dict[str, Any]:
        asked = {"expression": expression, "returnByValue": True, "awaitPromise": True}
        return self.call("Runtime.evaluate", **asked)

    def choose(self, id_: str, value: str) -> None:
        """Change a select or an input, as a person does."""
        self.value(
            f"(e => {{ e.value = '{value}'; e.dispatchEvent(new Event('change')); }})"
            f"(document.getElementById('{id_}'))"
        )

    def colours(self, scheme: str, medium: str = "") -> None:
        """`dark` or `light`; medium : `print`, or "" for the screen."""
        feature = {"name": "prefers-color-scheme", "value": scheme}
        self.call("Emulation.setEmulatedMedia", media=medium, features=[feature])

    def size(self, width: int, height: int) -> None:
        """Of the window, in pixels; a narrow one is a phone's."""
        more = {"deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, **more)

    def picture(self, path: Path) -> None:
        """The window as it is, as PNG."""
        path.write_bytes(b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def until(self, expression: str, within: float = WITHIN) -> None:
        """Wait until it is true in the page; one that is just being loaded has not all parts."""

        def true() -> bool:
            return self._evaluated(expression)["result"].get("value") is True

        found(true, within, said=expression)

    def text(self, id_: str) -> str:
        return str(self.value(f"document.getElementById('{id_}')?.textContent ?? ''"))

    def click(self, id_: str) -> None:
        self.until(
            f"document.getElementById('{id_}') && !document.getElementById('{id_}').disabled"
        )
        self.value(f"document.getElementById('{id_}').click()")

    def press(self, key: str) -> None:
        """A key, as from a keyboard."""
        number, text = KEYS.get(key, (ord(key[0].upper()), key))
        more = {"key": key, "code": key, "windowsVirtualKeyCode": number}
        self.call(
            "Input.dispatchKeyEvent", type="keyDown", **more, **({"text": text} if text else {})
        )
        self.call("Input.dispatchKeyEvent", type="keyUp", **more)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(WITHIN)


def violations(browser: Browser) -> list[Any]:
    """What axe finds wrong with the page as it is now."""
    axe = (resources.files("axe_core_python") / "axe.min.js").read_text("utf-8")
    browser.value(f"{axe}; undefined")
    found = browser.value("axe.run(document).then((found) => JSON.stringify(found.violations))")
    return [(v["id"], v["help"], [n["html"][:120] for n in v["nodes"]]) for v in json.loads(found)]
