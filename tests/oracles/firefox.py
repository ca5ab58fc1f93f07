"""Headless Firefox by Marionette, the protocol that it comes with; Playwright drives one of its own."""

import contextlib
import json
import os
import shutil
import socket
import subprocess

from tests.oracles.painting import until

FIREFOX = shutil.which("firefox-esr") or shutil.which("firefox")


class Firefox:
    """A session with a window of 1280 x 800."""

    def __init__(self, port):
        self._count, self._socket = 0, socket.create_connection(("127.0.0.1", port), timeout=180)
        self._heard()
        self("WebDriver:NewSession", capabilities={})
        self("WebDriver:SetWindowRect", width=1280, height=800)

    def __call__(self, command, **parameters):
        """Carry out a command of WebDriver; returns its answer."""
        self._count += 1
        asked = json.dumps([0, self._count, command, parameters]).encode()
        self._socket.sendall(b"%d:%b" % (len(asked), asked))
        _, _, error, answer = self._heard()
        assert error is None, error
        return answer

    def _heard(self):
        length = b""
        while not length.endswith(b":"):
            length += self._socket.recv(1)
        missing, parts = int(length[:-1]), []
        while missing:
            parts.append(self._socket.recv(missing))
            missing -= len(parts[-1])
        return json.loads(b"".join(parts))

    def close(self):
        self._socket.close()

    def run(self, script):
        return self("WebDriver:ExecuteScript", script=script, args=[])["value"]

    def box(self, name):
        """Return left, top, width and height of an element."""
        found = f"const r = document.querySelector({name!r}).getBoundingClientRect();"
        return self.run(f"{found} return [r.x, r.y, r.width, r.height];")

    def drag(self, *places):
        """Press the pointer at the first place, and release it at the last."""
        moves = [{"type": "pointerMove", "duration": 50, "x": round(x), "y": round(y)} for x, y in places]
        down, up = {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}
        pointer = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}}
        pointer["actions"] = [moves[0], down, *moves[1:], up]
        self("WebDriver:PerformActions", actions=[pointer])


@contextlib.contextmanager
def firefox(folder):
    """Start Firefox with a profile in a folder; yields a session."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (folder / "user.js").write_text(f'user_pref("marionette.port", {port});\n')
    command = [FIREFOX, "--headless", "--marionette", "--profile", str(folder)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command, env=os.environ | {"HOME": str(folder)}, **quiet)
    found = []
    try:

        def connected():
            with contextlib.suppress(OSError):
                found.append(Firefox(port))
            return found

        until(connected)
        yield found[0]
    finally:
        for one in found:
            one.close()
        process.terminate()
        process.wait(60)
