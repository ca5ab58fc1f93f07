"""``envedit paint`` without a browser: who is let in, what is refused, several pages, ends."""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from tests.oracles.builders import LIGHT, write_scene
from tests.oracles.painting import OF_TWO, SMALL, TWO_VIEWS, served, until

pytestmark = pytest.mark.slow
pytest.importorskip("starlette", reason="the extra envedit[paint] is not installed")
pytest.importorskip("uvicorn", reason="the extra envedit[paint] is not installed")
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


def connected(server, **more):
    origin = more.pop("origin", server.origins[0])
    return client.connect(server.url.replace("http", "ws") + "ws", origin=origin, max_size=None, **more)


def heard(socket, kind, wanted=lambda message: True):
    """Return the next message of a kind."""
    while True:
        received = socket.recv(timeout=60)
        if isinstance(received, str):
            message = json.loads(received)
            if message["type"] == kind and wanted(message):
                return message


def shown(socket):
    """Return the next picture of T E, (h, w, 3)."""
    while True:
        received = socket.recv(timeout=60)
        if isinstance(received, bytes) and received[4:6] == b"\0\0":
            width, height = struct.unpack("<HH", received[6:10])
            return np.frombuffer(received[16:], "<f2").reshape(height, width, 3).astype(np.float32)


def asked(address, **more):
    """Return status and body of an HTTP request."""
    try:
        with urllib.request.urlopen(urllib.request.Request(address, **more), timeout=30) as answer:
            return answer.status, answer.read().decode("utf-8", "replace")
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


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
    for name in (
        "../secret.txt",
        "..%2fsecret.txt",
        "result/..%2f..%2fsecret.txt",
        "result/painted.toml",
        "x.py",
    ):
        code, text = asked(server.url + name)
        assert code in (403, 404) and "not to be served" not in text, name
    put = {"method": "PUT", "data": b"#?RADIANCE", "headers": {"Origin": server.origins[0]}}
    assert asked(f"{server.url}map/a.hdr", **put)[0] == 409  # on the start page only
    assert set(os.listdir()) <= {"edit.toml", "edit_out", "secret.txt"}


def test_bad_messages_are_told_and_huge_ones_end_the_connection(server):
    with connected(server) as page:
        page.send("{")
        assert "expected JSON" in heard(page, "refused")["text"]
        page.send(b"\x00" * 100)
        assert "expected JSON text" in heard(page, "refused")["text"]
        page.send(json.dumps({"type": "document", "document": {"strokes": 3}}))
        assert "document.strokes" in heard(page, "refused")["text"]
        heard(page, "status")  # it goes on
        with pytest.raises(exceptions.ConnectionClosed) as closed:
            page.send("x" * (2 << 20))
            while True:
                page.recv(timeout=60)
        assert closed.value.rcvd.code == 1009
    assert server.worker.is_alive()


def test_two_pages_see_one_painting_and_one_that_comes_back_has_it_all(server):
    stroke = {"type": "light", "ellipse": [0.5, 0.8, 0.2, 0.1], "amount": 0.3}
    with connected(server) as one, connected(server) as other:
        mine = heard(one, "hello")["client"]
        assert heard(other, "hello")["client"] != mine
        heard(one, "opened"), heard(other, "opened")
        one.send(json.dumps({"type": "document", "number": 5, "document": {"strokes": [stroke]}}))
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
        again.send(json.dumps({"type": "document", "number": 6, "document": {}}))
        heard(again, "status", lambda m: m.get("number") == 6)
    until(lambda: server.worker.session.document.empty)


def test_a_highlight_tells_its_light_and_the_light_follows_a_pixel(server):
    with connected(server) as page:
        heard(page, "lights")
        page.send(json.dumps({"type": "pick", "x": 0.3, "y": 0.15, "number": 1}))
        assert heard(page, "picked")["light"] == 0
        found = []
        for x in (0.4, 0.6):  # on the sphere, to the left and to the right of its middle
            page.send(json.dumps({"type": "pick", "x": x, "y": 0.45, "light": 0, "number": 2}))
            found.append(heard(page, "picked")["azimuth"])
        turned = (found[1] - found[0] + 180) % 360 - 180
        assert abs(turned) > 10, found


def test_a_light_that_was_placed_is_told_with_the_number_of_its_edit(server):
    with connected(server) as page:
        bare = shown(page)
        light = {"light": 1, "azimuth": 270.0, "elevation": 40.0}
        for number, phase in ((9, "dragging"), (10, "done")):
            edit = {"type": "document", "number": number, "phase": phase, "document": {"lights": [light]}}
            page.send(json.dumps(edit))
            heard(page, "status", lambda m, number=number: m.get("number") == number)
        page.send(json.dumps({"type": "document", "number": 11, "document": {"lights": [light]}}))
        moved = shown(page)
        page.send(json.dumps({"type": "document", "number": 12, "document": {}}))
        heard(page, "status", lambda m: m.get("number") == 12)
    left, right = (slice(36, 39), slice(8, 11)), (slice(36, 39), slice(40, 43))
    assert moved[left].mean() > 1.5 * bare[left].mean(), "its shadow is still where it was"
    assert moved[right].mean() < bare[right].mean()


def test_strokes_belong_to_the_view_that_was_painted_in_and_others_hold(tmp_path):
    write_scene(tmp_path, *TWO_VIEWS, LIGHT, name="scene.xml")
    (tmp_path / "edit.toml").write_text(OF_TWO)
    square = {"rectangle": [0.3, 0.3, 0.7, 0.7], "softness": 0.05}
    light, shadow = {"type": "light", "amount": 0.1, **square}, {"type": "shadow", "amount": 0.4, **square}

    with served(tmp_path / "edit.toml") as server, connected(server) as page:
        assert heard(page, "opened")["views"] == ["front", "behind"]
        session, count = server.worker.session, 0

        def painted(*strokes):
            """Return what strokes ask for in each view, and what the solution leaves of it."""
            nonlocal count
            count += 1
            page.send(json.dumps({"type": "document", "number": count, "document": {"strokes": strokes}}))
            heard(page, "status", lambda m: m.get("number") == count and m["state"] == "done")
            under = session.coverage
            changes = session.target - session.base, under * (session.target - session.point.rendering)
            return [change[rows] for change in changes for rows in session.lit.rows]

        front, behind, _, _ = painted({**shadow, "view": 1})
        assert not front.any() and behind[10:18, 11:21].mean() < -0.02 and not behind[0].any()
        front, behind, *left = painted(light, {**shadow, "view": "behind"})
        assert front[6:14, 11:21].mean() > 0.05 and behind[10:18, 11:21].mean() < -0.02
        for asked, rest in zip((front, behind), left, strict=True):
            assert np.square(rest).sum() < 0.5 * np.square(asked).sum(), "not solved for together"
        with connected(server) as other:
            sizes = {}
            while {(source, v) for source in (0, 1) for v in (0, 1)} - set(sizes):
                received = other.recv(timeout=60)
                if isinstance(received, bytes) and received[4] == 0:
                    width, height, _, view = struct.unpack("<HHIH", received[6:16])
                    sizes[received[5], view] = width, height
        assert sizes == {(0, 0): (32, 20), (0, 1): (32, 28), (1, 0): (64, 40), (1, 1): (64, 56)}
        page.send(json.dumps({"type": "document", "document": {"strokes": [{**light, "view": 2}]}}))
        assert "got view 2, expected one of 0 (front), 1 (behind)" in heard(page, "error")["text"]
        toward = []
        for view in (0, 1):
            page.send(json.dumps({"type": "pick", "x": 0.5, "y": 0.5, "light": 0, "view": view}))
            toward.append(heard(page, "picked")["azimuth"])
        assert abs((toward[1] - toward[0]) % 360 - 180) < 60, toward


def test_a_scene_is_opened_from_the_start_page_and_mistakes_are_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "edit.toml").write_text(SMALL)
    with served(None) as server, connected(server) as page:
        assert "sphere" in heard(page, "start")["scenes"]
        put = {"method": "PUT", "data": b"#?RADIANCE", "headers": {"Origin": server.origins[0]}}
        for name in ("..%2fout.exr", "out.py", ".exr", "a%00.exr"):
            assert asked(f"{server.url}map/{name}", **put)[0] in (400, 403, 404), name
        assert asked(f"{server.url}map/a.hdr", **{**put, "headers": {}})[0] == 403
        code, path = asked(f"{server.url}map/a.hdr", **put)
        assert code == 200 and path == "maps/a.hdr" and Path(path).read_bytes() == b"#?RADIANCE"
        assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*.*")) == [
            "edit.toml",
            "maps/a.hdr",
        ]
        page.send(json.dumps({"type": "save"}))
        assert "no scene is open" in heard(page, "error")["text"]
        page.send(json.dumps({"type": "open", "name": "nowhere.toml"}))
        assert "no such configuration" in heard(page, "error")["text"]
        page.send(json.dumps({"type": "open", "name": "edit.toml", "envmap": "missing.exr"}))
        assert "missing.exr" in heard(page, "error")["text"]
        page.send(json.dumps({"type": "open", "name": "edit.toml"}))
        assert heard(page, "opened")["width"] == 48


def test_a_busy_port_is_told_and_ctrl_c_ends_it(tmp_path):
    command = [sys.executable, "-m", "envedit", "paint", "--no-browser", "--port"]
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        done = subprocess.run(
            [*command, port], cwd=tmp_path, capture_output=True, text=True, timeout=60, env=_env()
        )
    assert done.returncode == 2 and f"port {port} on 127.0.0.1: cannot be used" in done.stderr, done.stderr
    running = subprocess.Popen(
        [*command, "0"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=_env()
    )
    url = running.stdout.readline().split()[-1]
    until(lambda: asked(url)[0] == 200)
    running.send_signal(signal.SIGINT)
    said, wrong = running.communicate(timeout=60)
    assert running.returncode == 0 and "ended" in said and not wrong, wrong


def _env():
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    return os.environ | {"PYTHONPATH": root}
