"""A page in headless Chromium that is driven with a mouse, through the DevTools protocol."""

import base64
import contextlib
import json
import shutil
import subprocess
import time
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next(filter(None, map(shutil.which, NAMES)), None)


class Tab:
    """A tab that shows an address; a context manager that ends the browser."""

    def __init__(self, address, folder, size=(1400, 1000), drawn=True):
        from websockets.sync.client import connect

        words = "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader "
        words += f"--no-first-run --window-size={size[0]},{size[1]} --remote-debugging-port=0"
        command = [BROWSER, *words.split(), f"--user-data-dir={folder}", "about:blank"]
        self._process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        self.said = []  # errors on the console
        try:
            told = Path(folder) / "DevToolsActivePort"
            until(lambda: told.is_file() and told.read_text().count("\n"))
            port, path = told.read_text().split()
            settings = {"max_size": None, "compression": None, "ping_interval": None}
            self._socket = connect(f"ws://127.0.0.1:{port}{path}", **settings)
            self._count, self._session = 0, {}
            pages = self.call("Target.getTargets")["targetInfos"]
            page = next(one["targetId"] for one in pages if one["type"] == "page")
            made = self.call("Target.attachToTarget", targetId=page, flatten=True)
            self._session = {"sessionId": made["sessionId"]}
            self.call("Runtime.enable")
            self.resize(*size)
            if not drawn:
                self.call("Page.enable")
                script = (
                    "for (const name of ['drawArrays', 'drawElements', 'drawArraysInstanced', "
                    "'drawElementsInstanced', 'blitFramebuffer', 'clear'])"
                    "WebGL2RenderingContext.prototype[name] = () => {};"
                )
                self.call("Page.addScriptToEvaluateOnNewDocument", source=script)
            self.call("Page.navigate", url=address)
        except BaseException:
            self.close()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def close(self):
        with contextlib.suppress(Exception):
            self._socket.close()
        self._process.terminate()
        self._process.wait(timeout=30)

    def resize(self, width, height):
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=width < 600,
        )  # fmt: skip

    def call(self, method, **params):
        """Send a command and return its result."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": params, **self._session}
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("method") == "Runtime.exceptionThrown":
                self.said.append(answer["params"]["exceptionDetails"])
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]

    def value(self, script):
        """Return the value of a JavaScript expression."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def text(self):
        """Return the text of the page."""
        return self.value("document.body?.innerText") or ""

    def middle(self, text, beside=None):
        """Return the middle [pixels] of the innermost element with a text; None: not there.

        beside: selector of the element that is wanted instead: the nearest one beside the text.
        """
        return self.value(
            "(() => { let e = [...document.body.querySelectorAll('*')]"
            f".filter((e) => e.textContent.trim() === {json.dumps(text)}).pop();"
            f"const beside = {json.dumps(beside)};"
            "while (e && beside && !e.querySelector(beside)) e = e.parentElement;"
            "e = e && beside ? e.querySelector(beside) : e;"
            "if (!e) return null; e.scrollIntoView({block: 'nearest'});"
            "const r = e.getBoundingClientRect();"
            "return r.height ? [r.x + r.width / 2, r.y + r.height / 2] : null; })()"
        )

    def place(self, text, beside=None):
        """Return `middle` of an element as soon as it is there and does not move.

        A folder that opens moves it, but not in 0.1 s where the machine is busy.
        """

        def resting():
            before = self.middle(text, beside)
            time.sleep(0.1)
            moving = self.value("document.getAnimations().length")
            return before if not moving and before == self.middle(text, beside) else None

        return until(resting)

    def mouse(self, kind, at, buttons=0):
        """Press, release or move the mouse at a point [pixels]."""
        button = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
        x, y = at
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, buttons=buttons, **button)

    def click(self, at, done, beside=None):
        """Click until a test is true: a page that is still being made loses clicks.

        Args:
            at: point [pixels], or text of an element, see `middle`.
            done: function without arguments.
            beside: see `middle`.
        """

        def clicked():
            point = self.place(at, beside) if isinstance(at, str) else at
            self.mouse("mouseMoved", point)
            time.sleep(0.05)
            self.mouse("mousePressed", point, 1)
            self.mouse("mouseReleased", point)
            end = time.monotonic() + 3.0
            while not (found := done()) and time.monotonic() < end:
                time.sleep(0.02)
            return found

        return until(clicked)

    def drag(self, start, end, steps=5):
        """Drag the mouse from a point to another one [pixels]."""
        self.mouse("mouseMoved", start)
        time.sleep(0.1)
        self.mouse("mousePressed", start, 1)
        for k in range(1, steps + 1):
            at = [a + (b - a) * k / steps for a, b in zip(start, end, strict=True)]
            self.mouse("mouseMoved", at, 1)
            time.sleep(0.02)
        self.mouse("mouseReleased", end)

    def screenshot(self):
        """Return a picture of the tab as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])


def until(test, seconds=30.0):
    """Wait until a test is true and return its result."""
    end = time.monotonic() + seconds
    while not (found := test()):
        assert time.monotonic() < end, "nothing came in time"
        time.sleep(0.02)
    return found
