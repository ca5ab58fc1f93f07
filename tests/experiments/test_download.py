"""Fetching PureSky maps from a stand-in for Poly Haven that misbehaves."""

import hashlib
import http.server
import os
import re
import sys
import threading
import types

import pooch.core
import pytest

from experiments import download_puresky as fetch
from experiments import puresky
from tests.oracles import ROOT

BODY = bytes(range(256)) * 400  # 102,400 bytes: more than a chunk
FILE = "north_field_puresky_1k.hdr"


class StandIn(http.server.ThreadingHTTPServer):
    """Files by name; ``does[name]`` is what it does to the next requests for a file."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.bodies = {FILE: BODY}
        self.does, self.seen = {}, []


class Handler(http.server.BaseHTTPRequestHandler):
    def log_message(self, *args):
        pass

    def do_GET(self):
        here, name = self.server, self.path.rpartition("/")[2]
        here.seen.append((name, dict(self.headers)))
        doing = here.does.get(name, [])
        action = doing.pop(0) if doing else "fine"
        body = here.bodies.get(name, b"")
        self.send_response(404 if name not in here.bodies else 503 if action == "busy" else 200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if action == "wrong":
            body = body[:-1] + b"!"
        self.wfile.write(body[: len(body) // 2] if action == "truncated" else body)


@pytest.fixture
def there(monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(fetch, "MAPS", {"north_field": hashlib.md5(BODY).hexdigest()})
    monkeypatch.setattr(pooch.core, "time", types.SimpleNamespace(sleep=lambda seconds: None))
    with StandIn() as server:
        monkeypatch.setattr(fetch, "ADDRESS", f"http://127.0.0.1:{server.server_port}/1k/")
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def test_the_maps_are_those_of_the_pages():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    listed = re.search(r"\| `puresky` \| 13 maps .*?: ([\w, ]+)\.", text)[1]
    assert listed.split(", ") == list(fetch.MAPS)


@pytest.mark.skipif("ENVEDIT_DATA" not in os.environ, reason="ENVEDIT_DATA is not set")
def test_the_maps_are_those_that_experiments_are_made_over():
    found = {name: hashlib.md5(file.read_bytes()).hexdigest() for name, file in puresky.find().items()}
    assert {name: found[name] for name in fetch.MAPS} == fetch.MAPS


def test_a_map_that_is_there_is_left_alone_and_a_changed_one_fetched_again(there, tmp_path):
    assert fetch.download(tmp_path) == []
    assert (tmp_path / FILE).read_bytes() == BODY and (tmp_path / FILE).stat().st_mode & 0o777 == 0o644
    ((name, headers),) = there.seen
    assert name == FILE and headers["User-Agent"].startswith("envedit/")
    assert fetch.download(tmp_path) == [] and len(there.seen) == 1
    (tmp_path / FILE).write_bytes(BODY[:-1] + b"?")
    assert fetch.download(tmp_path) == []
    assert (tmp_path / FILE).read_bytes() == BODY


@pytest.mark.parametrize(
    ("action", "reason"), [("truncated", "IncompleteRead"), ("wrong", "MD5"), ("busy", "503")]
)
def test_a_damaged_file_is_fetched_whole_again_and_never_kept(there, tmp_path, action, reason):
    there.does[FILE] = [action]
    assert fetch.download(tmp_path) == []
    assert (tmp_path / FILE).read_bytes() == BODY
    (tmp_path / FILE).unlink()
    there.does[FILE] = [action] * 9
    (line,) = fetch.download(tmp_path)
    assert line.startswith(FILE) and reason in line
    assert len(there.does[FILE]) == 9 - fetch.TRIES
    assert list(tmp_path.iterdir()) == []


def test_a_map_that_cannot_be_had_does_not_stop_the_others(there, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(fetch, "MAPS", {"gone": "0" * 32} | fetch.MAPS)
    assert fetch.main([str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert said.err.startswith("gone_puresky_1k.hdr: 404") and "1 of 2 maps are in" in said.out
    assert [path.name for path in tmp_path.iterdir()] == [FILE]


def test_without_pooch_one_line_names_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    assert fetch.main([str(tmp_path)]) == 4
    said = capsys.readouterr().err
    assert said.startswith("download_puresky: fetching maps: needs pooch, ") and len(said.splitlines()) == 1
