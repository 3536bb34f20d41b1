"""A headless Chromium, driven by its DevTools protocol: just enough for the tests of the viewer."""

import base64
import contextlib
import json
import os
import re
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def find():
    """The browser's path, or None; $CHROMIUM names another one."""
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    def __init__(self, width=1280, height=800):
        self.folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        # drawn by the processor, as where there is no graphics card
        flags = "--headless --disable-gpu --enable-unsafe-swiftshader --no-first-run "
        flags += "--no-sandbox --disable-dev-shm-usage --hide-scrollbars --remote-debugging-port=0 "
        flags += f"--window-size={width},{height} --user-data-dir={self.folder.name}"
        self.process = subprocess.Popen(
            [find(), *flags.split(), "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        port = self.wait(lambda: self._port())
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            pages = [each for each in json.load(answer) if each["type"] == "page"]
        from websockets.sync.client import connect

        self.opened = contextlib.ExitStack()
        address = pages[0]["webSocketDebuggerUrl"]
        # no pings: what the page tells while nobody listens fills the queue, and their answers wait behind it
        socket = connect(address, max_size=None, compression=None, ping_interval=None)
        self.socket = self.opened.enter_context(socket)
        self.number, self.messages = 0, []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.size(width, height)

    def _port(self):
        file = Path(self.folder.name) / "DevToolsActivePort"
        return file.read_text().split()[0] if file.exists() and file.read_text().strip() else None

    def wait(self, true, seconds=30.0):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            found = true()
            if found:
                return found
            time.sleep(0.02)
        raise TimeoutError(f"not within {seconds} s; the page said {self.errors()}")

    def call(self, method, **params):
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": params}))
        while True:
            message = json.loads(self.socket.recv(timeout=60))
            if message.get("id") == self.number:
                assert "error" not in message, message["error"]
                return message["result"]
            self.messages.append(message)

    def run(self, script):
        """The value of a JavaScript expression; promises are waited for."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def open(self, address):
        self.messages.clear()
        self.call("Page.navigate", url=address)
        self.wait(lambda: self.run("Boolean(window.viewer && window.viewer.frames > 0)"))

    def size(self, width, height, dark=False):
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.call("Emulation.setEmulatedMedia", features=scheme)

    def drag(self, selector, part):
        """Press on a slider's middle and drag to a part of its width, as a hand does."""
        x, y, width, height = self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            " e.scrollIntoView({block: 'center'});"
            " const r = e.getBoundingClientRect(); return [r.x, r.y, r.width, r.height]; })()"
        )
        points = [x + 0.5 * width + k / 5 * (part - 0.5) * (width - 16) for k in range(6)]
        self.mouse("mousePressed", points[0], y + height / 2)
        for point in points[1:]:
            self.mouse("mouseMoved", point, y + height / 2)
        self.mouse("mouseReleased", points[-1], y + height / 2)

    def mouse(self, kind, x, y):
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def errors(self):
        """What the console says of errors and warnings, and what the page wanted from elsewhere."""
        found = []
        for message in self.messages:
            params = message.get("params", {})
            if message.get("method") == "Runtime.exceptionThrown":
                found.append(params["exceptionDetails"].get("exception", {}).get("description"))
            elif message.get("method") == "Runtime.consoleAPICalled" and params["type"] in (
                "error",
                "warning",
            ):
                found.append(str([arg.get("value") for arg in params["args"]]))
            elif message.get("method") == "Log.entryAdded" and params["entry"]["level"] == "error":
                found.append(params["entry"]["text"])
        return [re.sub(r"data:[^\s:]{40,}", "data:…", str(text))[:2000] for text in found]

    def requests(self):
        sent = [
            m["params"]["request"]["url"]
            for m in self.messages
            if m.get("method") == "Network.requestWillBeSent"
        ]
        return [url for url in sent if not url.startswith(("data:", "blob:"))]

    def picture(self, path):
        data = self.call("Page.captureScreenshot", format="png")["data"]
        Path(path).write_bytes(base64.b64decode(data))

    def close(self):
        self.opened.close()
        self.process.terminate()
        self.process.wait(10)
        self.folder.cleanup()
