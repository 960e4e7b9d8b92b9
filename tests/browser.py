"""Debian's Chromium without a window, driven by its own DevTools protocol."""

import itertools
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

from websockets.sync.client import connect

CHROMIUM = shutil.which("chromium")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--window-size=1280,800",
    "--remote-debugging-port=0",
)


class Browser:
    """One tab; `seen` are the addresses that it asked for."""

    def __init__(self, address):
        self.folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        folder = f"--user-data-dir={self.folder.name}"
        self.process = subprocess.Popen(
            [CHROMIUM, *FLAGS, folder, "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port = Path(self.folder.name) / "DevToolsActivePort"
        wait_for(lambda: port.exists() and port.read_text().strip())
        tabs = f"http://127.0.0.1:{port.read_text().split()[0]}/json/list"
        with urllib.request.urlopen(tabs) as answer:
            tab = next(t for t in json.load(answer) if t["type"] == "page")
        self.socket = connect(tab["webSocketDebuggerUrl"], max_size=None)
        self.ids, self.seen = itertools.count(1), []
        self.call("Network.enable")
        self.call("Page.enable")
        self.call("Page.navigate", url=address)

    def call(self, method, **params):
        number = next(self.ids)
        self.socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self.socket.recv(timeout=60))
            if message.get("method") == "Network.requestWillBeSent":
                self.seen.append(message["params"]["request"]["url"])
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]

    def evaluate(self, script):
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        return answer["result"].get("value")

    def text(self):
        return self.evaluate("document.body.innerText") or ""

    def mouse(self, kind, x, y, buttons=1):
        self.call(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y,
            button="left", buttons=buttons, clickCount=1,
        )  # fmt: skip

    def click(self, x, y):
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.mouse(kind, x, y)

    def click_on(self, script):
        """Click on the middle of the element that a script returns."""
        box = f"(() => {{ const e = {script}; e.scrollIntoView({{block: 'nearest'}}); "
        box += "const b = e.getBoundingClientRect(); "
        box += "return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        self.click(*self.evaluate(box))

    def type(self, text):
        self.call("Input.insertText", text=text)

    def press(self, key, code, **more):
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent", type=kind, key=key, code=key,
                windowsVirtualKeyCode=code, **more,
            )  # fmt: skip

    def close(self):
        self.socket.close()
        self.process.terminate()
        self.process.wait(10)
        self.folder.cleanup()


def wait_for(condition, seconds=60.0):
    """Return what a condition gives, once it holds."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.1)
    return found
