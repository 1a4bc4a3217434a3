"""A headless Chromium through a pipe of its debugging protocol: no port, no further package.

Tests take the fixture `tab`, which is a new reader's; all of a worker's are of one Chromium.
"""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

PROGRAM = next(
    (p for name in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(name))), None
)

#: Sum of the scene's pixels, and how many colours it has.
PIXELS = """(() => {
  const c = document.getElementById('scene'), gl = c.getContext('webgl2'), seen = new Set();
  const p = new Uint8Array(4 * c.width * c.height);
  gl.readPixels(0, 0, c.width, c.height, gl.RGBA, gl.UNSIGNED_BYTE, p);
  let sum = 0;
  for (let i = 0; i < p.length; i += 4) {
    const color = p[i] << 16 | p[i + 1] << 8 | p[i + 2];
    sum = (sum * 31 + color) % 4294967291; seen.add(color);
  }
  return [sum, seen.size];
})()"""


#: Time without an answer after which a test fails [s].
_PATIENCE = 120.0
#: A taller picture repeats its beginning [px].
_TALLEST = 8000


class Chromium:
    """Both ends of the pipe to a Chromium that runs."""

    def __init__(self, to: Any, back: Any) -> None:
        self._to, self._back, self._count, self._unread = to, back, 0, b""

    def ask(self, method: str, tab: Browser | None = None, **params: Any) -> dict[str, Any]:
        """The answer to a request of the browser, or of a tab, which hears what is told meanwhile."""
        self._count += 1
        request = {"id": self._count, "method": method, "params": params, **(tab.session if tab else {})}
        self._to.write(json.dumps(request).encode() + b"\0")
        self._to.flush()
        while True:
            answer = json.loads(self._message())
            if tab and answer.get("sessionId") == tab.session.get("sessionId"):
                tab.hear(answer.get("method", ""), answer.get("params", {}))
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]

    def _message(self) -> bytes:
        while (end := self._unread.find(b"\0")) < 0:
            # a script may await what never comes
            assert select.select([self._back], [], [], _PATIENCE)[0], f"no answer within {_PATIENCE:.0f} s"
            more = self._back.read(2**20)  # what there is; a picture has megabytes
            assert more, "Chromium has ended"
            self._unread += more
        whole, self._unread = self._unread[:end], self._unread[end + 1 :]
        return whole

    @contextmanager
    def tab(self, folder: Path) -> Iterator[Browser]:
        """A tab that shares nothing with others; where the block fails, `failure.png` shows why."""
        context = self.ask("Target.createBrowserContext")
        try:
            one = Browser(self, context)
            with picture_of_failure(one, folder):
                yield one
        finally:
            self.ask("Target.disposeBrowserContext", **context)


class Browser:
    """One tab. Scripts that fail fail the test; what pages say on the console is kept in `complaints`."""

    def __init__(self, chromium: Chromium, context: dict[str, Any]) -> None:
        self._chromium = chromium
        target = chromium.ask("Target.createTarget", url="about:blank", **context)["targetId"]
        attached = chromium.ask("Target.attachToTarget", targetId=target, flatten=True)
        self.session = {"sessionId": attached["sessionId"]}
        self.requests: list[str] = []
        self.complaints: list[str] = []
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.ask(f"{domain}.enable")

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        return self._chromium.ask(method, self, **params)

    def hear(self, event: str, told: dict[str, Any]) -> None:
        """Note what the page asks of a network, and what it says."""
        if event == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"])
        elif event == "Runtime.exceptionThrown":
            thrown = told["exceptionDetails"]
            self.complaints.append(thrown.get("exception", {}).get("description", thrown["text"]))
        elif event == "Runtime.consoleAPICalled" and told["type"] in ("error", "warning", "assert"):
            self.complaints.append(str(told["args"]))
        elif event == "Log.entryAdded" and told["entry"]["level"] in ("error", "warning"):
            self.complaints.append(told["entry"]["text"])

    def open(self, address: str, width: int = 1280, height: int = 900, dark: bool = False) -> None:
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.ask("Emulation.setEmulatedMedia", features=[scheme])
        self.ask("Page.navigate", url=address)
        self.run("new Promise((done) => document.readyState === 'complete' ? done() : onload = done)")

    def cut_off(self) -> None:
        """Take the network away."""
        none = {"latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
        self.ask("Network.emulateNetworkConditions", offline=True, **none)

    def run(self, script: str) -> Any:
        """Value of an expression, awaited."""
        result = self.ask("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def picture(self, path: Path, whole: bool = False) -> Path:
        """A screenshot of the window or the whole page: png, webp or jpeg, as the path's ending."""
        size, more = self.ask("Page.getLayoutMetrics")["cssContentSize"], {}
        if whole:
            clip = {
                "x": 0,
                "y": 0,
                "width": size["width"],
                "height": min(size["height"], _TALLEST),
                "scale": 1,
            }
            more = {"captureBeyondViewport": True, "clip": clip}
        taken = self.ask("Page.captureScreenshot", format=path.suffix[1:], **more)
        path.write_bytes(base64.b64decode(taken["data"]))
        return path


@contextmanager
def picture_of_failure(one: Browser, folder: Path) -> Iterator[None]:
    """Keep what the tab shows where the block fails."""
    try:
        yield
    except Exception as error:
        with suppress(OSError, AssertionError):
            error.add_note(f"the browser's tab: {one.picture(folder / 'failure.png')}")
        raise


@contextmanager
def chromium(folder: Path) -> Iterator[Chromium]:
    """A Chromium with an empty profile in a folder."""
    assert PROGRAM is not None
    (their_in, to), (back, their_out) = os.pipe(), os.pipe()
    options = (
        "--headless --no-sandbox --disable-gpu-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader "
        f"--no-first-run --disable-extensions --hide-scrollbars "
        f"--remote-debugging-pipe --user-data-dir={folder}"
    )
    command = f'exec "{PROGRAM}" {options} about:blank 3<&{their_in} 4>&{their_out}'
    quiet, ends = subprocess.DEVNULL, (their_in, their_out)
    with subprocess.Popen(["bash", "-c", command], pass_fds=ends, stdout=quiet, stderr=quiet) as process:
        os.close(their_in)
        os.close(their_out)
        with os.fdopen(to, "wb") as writer, os.fdopen(back, "rb", buffering=0) as reader:
            try:
                yield Chromium(writer, reader)
            finally:
                process.terminate()


@contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """One tab of a Chromium of its own."""
    with chromium(folder) as started, started.tab(folder) as one:
        yield one
