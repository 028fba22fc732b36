"""A headless Chromium for tests, spoken to in its own protocol."""

import base64
import contextlib
import itertools
import json
import subprocess
import time
import urllib.request

# Without a GPU, WebGL is computed.
OPTIONS = (
    "--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--window-size=1400,1000", "--remote-debugging-port=0", "--disable-extensions", "--disable-background-networking",
)  # fmt: skip


def wait_for(condition, seconds=60, pause=0.1):
    """What a function says once it is something."""
    end = time.monotonic() + seconds
    while not (answer := condition()):
        assert time.monotonic() < end, "nothing came of it in time"
        time.sleep(pause)
    return answer


class Page:
    """A page that is open."""

    def __init__(self, socket):
        self._socket, self._number = socket, itertools.count(1)

    def ask(self, method, **parameters):
        number = next(self._number)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def value(self, script):
        """What a script comes to."""
        return self.ask("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def picture(self):
        """The page as PNG."""
        return base64.b64decode(self.ask("Page.captureScreenshot")["data"])


@contextlib.contextmanager
def page(program, address, folder):
    """A page in a browser that is started, and ended afterwards.

    Args:
      program: Chromium.
      address: of the page.
      folder: where it may write.
    """
    from websockets.sync.client import connect

    command = [program, *OPTIONS, f"--user-data-dir={folder}", address]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as browser:
        try:
            port_file = folder / "DevToolsActivePort"
            port = wait_for(lambda: port_file.is_file() and port_file.read_text().split()[:1])[0]

            def opened():
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10) as answer:
                    pages = [one for one in json.load(answer) if one["url"].startswith(address)]
                return pages and pages[0]["webSocketDebuggerUrl"]

            with connect(wait_for(opened), max_size=None) as socket:
                yield Page(socket)
        finally:
            browser.terminate()
            browser.wait(20)
