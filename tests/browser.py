"""Chromium without a screen, by its DevTools protocol."""

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

from websockets.sync.client import connect

T = TypeVar("T")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_FLAGS = "--headless=new --no-sandbox --enable-unsafe-swiftshader --window-size=1280,800 --remote-debugging-port=0"


class Browser:
    """One page of one browser."""

    def __init__(self, url: str, folder: Path) -> None:
        """Open a page; the browser keeps its own files in `folder`."""
        assert CHROMIUM
        command = [CHROMIUM, *_FLAGS.split(), f"--user-data-dir={folder}", url]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        port = self._wait(lambda: (folder / "DevToolsActivePort").read_text().split()[0])
        pages = f"http://127.0.0.1:{port}/json/list"
        page = self._wait(lambda: next(p for p in json.load(urllib.request.urlopen(pages)) if p["type"] == "page"))
        self._socket, self._numbers = connect(page["webSocketDebuggerUrl"], max_size=None), count(1)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer to a call of the protocol."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while (answer := json.loads(self._socket.recv(timeout=60))).get("id") != number:
            pass
        return answer["result"]

    def text(self) -> str:
        """All that the page says."""
        return self.value("document.body.innerText")

    def value(self, expression: str) -> Any:
        """What a JavaScript expression is."""
        return self.call("Runtime.evaluate", expression=expression)["result"].get("value")

    def press(self, key: str, code: int) -> None:
        """Press a key and let it go: its name, such as ArrowUp, and its number."""
        for kind in ("rawKeyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    def screenshot(self, path: Path) -> None:
        """Write what is to be seen as a PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))

    def close(self) -> None:
        """End the browser."""
        self._socket.close()
        self._process.terminate()
        self._process.wait(10)

    @staticmethod
    def _wait(found: Callable[[], T], seconds: float = 60) -> T:
        until = time.monotonic() + seconds
        while True:
            try:
                return found()
            except (OSError, IndexError, StopIteration):
                if time.monotonic() > until:
                    raise
                time.sleep(0.1)
