"""``envedit paint`` without a browser: who is let in, what is refused, several pages, ends."""

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request

import pytest

from envedit.cli.paint import protocol
from envedit.cli.paint.protocol import Document
from tests.oracles import ROOT
from tests.oracles.painting import SMALL, asked, connected, heard, painted, send, served, until

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_core")]
client = pytest.importorskip("websockets.sync.client", reason="the extra envedit[paint] is not installed")
exceptions = pytest.importorskip("websockets.exceptions")


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A painting of a small scene, in a working folder of its own."""
    folder, before = tmp_path_factory.mktemp("paint"), os.getcwd()
    (folder / "edit.toml").write_text(SMALL)
    (folder / "secret.txt").write_text("not to be served")
    os.chdir(folder)
    with served(folder / "edit.toml") as found:
        until(lambda: "opened" in found.hub.last)
        yield found
    os.chdir(before)


def test_without_the_token_or_from_elsewhere_nobody_is_let_in(server):
    wrong = server.url.replace(server.token, "x" * len(server.token))
    assert asked(wrong)[0] == 403 and asked(wrong + "main.js")[0] == 403
    assert asked(server.url, headers={"Host": "evil.example"})[0] == 403
    with urllib.request.urlopen(server.url) as answer:
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    for origin in ("http://evil.example", f"http://127.0.0.1:{server.port + 1}", None):
        with pytest.raises(exceptions.InvalidStatus, match="403"):
            connected(server, origin=origin)
    with pytest.raises(exceptions.InvalidStatus, match="403"):
        client.connect(wrong.replace("http", "ws") + "ws", origin=server.origins[0])


def test_no_other_file_is_served_or_written(server):
    outside = "../secret.txt", "..%2fsecret.txt", "result/..%2f..%2fsecret.txt"
    for name in (*outside, "result/painted.toml", "x.py"):
        code, text = asked(server.url + name)
        assert code in (403, 404) and "not to be served" not in text, name
    put = {"method": "PUT", "data": b"#?RADIANCE", "headers": {"Origin": server.origins[0]}}
    assert asked(f"{server.url}map/a.hdr", **put)[0] == 409  # on the start page only
    assert set(os.listdir()) <= {"edit.toml", "edit_out", "secret.txt"}


def test_an_address_without_its_slash_is_not_redirected(server):
    for path in (f"/{server.token}", "/somebody/ws/", f"/{server.token}/main.js/"):
        with socket.create_connection(("127.0.0.1", server.port), timeout=30) as plain:
            plain.sendall(f"GET {path} HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n".encode())
            answer = plain.makefile("rb").read()
        assert answer.startswith(b"HTTP/1.1 404") and b"evil.example" not in answer, path


def test_while_a_message_is_read_others_are_served(server, monkeypatch):
    read, asked_for, waited = protocol.read, threading.Event(), []

    def slow(text, client=""):
        waited.append(asked_for.wait(20))
        return read(text, client)

    monkeypatch.setattr(protocol, "read", slow)
    with connected(server) as page:
        page.send("{")
        assert asked(server.url)[0] == 200
        asked_for.set()
        assert "expected JSON" in heard(page, "refused")["text"]
    assert waited == [True], "the page was served only after the message had been read"


def test_bad_messages_are_told_and_huge_ones_end_the_connection(server):
    with connected(server) as page:
        assert "Sec-WebSocket-Extensions" not in page.response.headers  # no frame is compressed
        page.send("{")
        assert "expected JSON" in heard(page, "refused")["text"]
        page.send(b"\x00" * 100)
        assert "expected JSON text" in heard(page, "refused")["text"]
        send(page, "document", document={"strokes": 3})
        assert "document.strokes" in heard(page, "refused")["text"]
        heard(page, "status")  # it goes on
        with pytest.raises(exceptions.ConnectionClosed) as closed:
            page.send("x" * (2 << 20))
            while True:
                page.recv(timeout=60)
        # Without a code where the server hangs up while the message is still being sent.
        assert closed.value.rcvd is None or closed.value.rcvd.code == 1009
    assert server.worker.is_alive()


def test_two_pages_see_one_painting_and_one_that_comes_back_has_it_all(server):
    stroke = {"type": "light", "ellipse": [0.5, 0.8, 0.2, 0.1], "amount": 0.3}
    with connected(server) as one, connected(server) as other:
        mine = heard(one, "hello")["client"]
        assert heard(other, "hello")["client"] != mine
        heard(one, "opened"), heard(other, "opened")
        send(one, "document", number=5, document={"strokes": [stroke]})
        assert heard(other, "document")["document"]["strokes"][0]["type"] == "light"
        done = heard(
            other, "status", lambda m: m["state"] == "done" and m.get("number") == 5 and m["iterations"]
        )
        assert done["client"] == mine
    with connected(server) as again:
        assert heard(again, "opened")["document"]["strokes"][0]["amount"] == 0.3
        frames = set()
        while not {0, 1, 2, 4} <= frames:
            received = again.recv(timeout=60)
            frames |= {received[4]} if isinstance(received, bytes) else set()
        reach = heard(again, "status", lambda m: m.get("reachable") is not None)["reachable"]
        assert 0 < reach <= 1
        painted(again, 6, {})
    until(lambda: server.worker.session.document == Document())


def test_what_is_unfinished_is_nobody_elses_and_not_saved(server):
    stroke = {"type": "shadow", "ellipse": [0.5, 0.8, 0.2, 0.1], "amount": 0.3}
    whole, half, dark = ({"strokes": n * [stroke]} for n in (1, 2, 3))
    session = server.worker.session
    with connected(server) as one, connected(server) as other:
        heard(one, "opened"), heard(other, "opened")
        send(one, "document", number=30, document=whole)
        assert len(heard(other, "document")["document"]["strokes"]) == 1
        painted(one, 31, half, phase="drawing")
        until(lambda: session.phase == "drawing")
        send(one, "save")
        heard(one, "status", lambda m: m["state"] == "saving")
        states, told = set(), {}
        while told.get("type") != "saved":
            received = one.recv(timeout=60)
            told = json.loads(received) if isinstance(received, str) else {}
            states |= {told["state"]} if told.get("type") == "status" else set()
        assert states <= {"saving"}, "what else goes on is told while it is saved"
        assert "saved" in server.hub.last
        assert session.document.strokes == session.finished.strokes and len(session.finished.strokes) == 1
        painted(one, 32, {**whole, "exposure": 1})
        assert "saved" not in server.hub.last, "a page that comes is told that this is saved"
        painted(one, 33, whole)
        # ---- A message that is refused: the page gets what is painted
        send(one, "document", number=34, document={"strokes": [stroke, {"type": "rain"}]})
        assert "rain" in heard(one, "refused")["text"]
        assert len(heard(one, "document", lambda m: not m["client"])["document"]["strokes"]) == 1
        # ---- A page that comes anew, as where it is reloaded while a stroke is drawn
        painted(one, 35, dark, phase="drawing")
        with connected(server) as again:
            assert len(heard(again, "opened")["document"]["strokes"]) == 1
            until(lambda: session.phase == "done" and len(session.document.strokes) == 1)
        painted(one, 36, {})


def test_done_is_told_once_and_what_goes_on_by_one_word_each(server):
    stroke = {"type": "erase-shadow", "ellipse": [0.62, 0.3, 0.12, 0.12], "softness": 0.05}
    told, kept = [], {"strokes": [stroke], "rest": "keep"}
    with connected(server) as page:
        send(page, "document", number=20, document=kept)
        while not told or told[-1] != "done":
            status = heard(page, "status", lambda m: m.get("number") == 20)
            told.append(status["state"])
        assert status["hold"] > 1, "the weight of what was not painted is not told"
        with pytest.raises(TimeoutError):
            while True:
                received = page.recv(timeout=3)
                told += [json.loads(received).get("state")] if isinstance(received, str) else []
        states = [state for state, _ in itertools.groupby(filter(None, told))]
        assert states == ["solving", "rendering", "done"]
        painted(page, 21, {})


def test_a_highlight_tells_its_light_and_the_light_follows_a_pixel(server):
    with connected(server) as page:
        heard(page, "lights")
        send(page, "pick", x=0.3, y=0.15, number=1)
        assert heard(page, "picked")["light"] == 0
        found = []
        for x in (0.4, 0.6):  # on the sphere, to the left and to the right of its middle
            send(page, "pick", x=x, y=0.45, light=0, number=2)
            found.append(heard(page, "picked")["azimuth"])
        turned = (found[1] - found[0] + 180) % 360 - 180
        assert abs(turned) > 10, found
        send(page, "pick", x=0.5, y=0.45, light=0, number=3)
        reflected = heard(page, "picked")
        assert abs(reflected["azimuth"] - 180) < 5 and abs(reflected["elevation"] - 25) < 5, reflected
        send(page, "pick", x=0.5, y=0.9, light=0, number=4)
        floor = heard(page, "picked")
        assert "not glossy" in floor["text"] and "azimuth" not in floor, floor


def test_a_busy_port_is_told_and_ctrl_c_ends_it(tmp_path):
    command = [sys.executable, "-m", "envedit", "paint", "--no-browser", "--port"]
    given = os.environ | {"PYTHONPATH": str(ROOT)}
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        done = subprocess.run(
            [*command, port], cwd=tmp_path, capture_output=True, text=True, timeout=60, env=given
        )
    assert done.returncode == 2 and f"port {port} on 127.0.0.1: cannot be used" in done.stderr, done.stderr
    running = subprocess.Popen(
        [*command, "0"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=given
    )
    url = running.stdout.readline().split()[-1]
    until(lambda: asked(url)[0] == 200)
    running.send_signal(signal.SIGINT)
    said, wrong = running.communicate(timeout=60)
    assert running.returncode == 0 and "ended" in said and not wrong, wrong
