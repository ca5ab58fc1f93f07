"""Fetching PureSky maps from a stand-in for Poly Haven that misbehaves."""

import email.utils
import hashlib
import http.server
import json
import sys
import threading
import time
import types
import urllib.parse

import pooch.core
import pytest
import urllib3.util.retry

from envedit.cli.progress import Progress
from experiments import download_puresky as fetch

GOOD = "north_field_puresky"
BODY = bytes(range(256)) * 400  # 102,400 bytes: more than a chunk


class StandIn(http.server.ThreadingHTTPServer):
    """Poly Haven's API and its files; ``does[path]`` is what it does to the next requests for a path."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.base = f"http://127.0.0.1:{self.server_port}"
        self.bodies = {GOOD: BODY}
        self.assets = {GOOD: {"category": "Pure Skies"}, "courtyard": {"category": "Urban"}}
        self.does, self.seen, self.answers = {}, [], {}

    def entry(self, slug):
        body = self.bodies[slug]
        md5 = hashlib.md5(body).hexdigest()
        return {"url": f"{self.base}/map/{slug}", "md5": md5, "size": len(body)}

    def document(self, path):
        if path in self.answers:
            return self.answers[path]
        if path == "/assets":
            return self.assets
        slug = path.removeprefix("/files/")
        return {"hdri": {"1k": {"hdr": self.entry(slug), "exr": {}}}} if slug in self.bodies else None

    def handle_error(self, request, client_address):
        pass  # the client may go away at any time


class Handler(http.server.BaseHTTPRequestHandler):
    def log_message(self, *args):
        pass

    def do_GET(self):
        here, path = self.server, urllib.parse.urlsplit(self.path).path
        here.seen.append((self.path, dict(self.headers)))
        doing = here.does.get(path, [])
        action = doing.pop(0) if doing else "fine"
        status, headers = action if isinstance(action, tuple) else (200, {})
        if path.startswith("/map/"):
            body = here.bodies[path.removeprefix("/map/")]
        else:
            body = here.document(path)
            status = 404 if body is None else status
            body = body if isinstance(body, bytes) else json.dumps(body).encode()
        body = body[:-1] + b"!" if action == "wrong" else body * 50 if action == "endless" else body
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(body))} | headers).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body[: len(body) // 2] if action in ("truncated", "silent") else body)
        if action == "silent":
            self.wfile.flush()
            time.sleep(0.8)


@pytest.fixture
def there(monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with StandIn() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def waits(monkeypatch):
    """Seconds that the program would have waited, besides the pauses of 0.25 s."""
    waits, clock = [], types.SimpleNamespace(time=time.time, monotonic=time.monotonic)
    clock.sleep = lambda seconds: seconds == 0.25 or waits.append(seconds)
    for module in (fetch, pooch.core, urllib3.util.retry):
        monkeypatch.setattr(module, "time", clock)
    return waits


@pytest.fixture(autouse=True)
def hasty(monkeypatch):
    monkeypatch.setattr(fetch, "PAUSE", 0.25)
    monkeypatch.setattr(fetch, "SILENCE", 0.3)


def get(there, folder):
    return fetch.download(folder, fetch.connected(), Progress(quiet=True), there.base)


FILE = f"{GOOD}_1k.hdr"
MAP = f"/map/{GOOD}"


def test_maps_of_the_category_are_fetched_and_listed(there, waits, tmp_path):
    fetched, present, failed = get(there, tmp_path / "new")
    assert (fetched, present, failed) == ([FILE], [], [])
    assert (tmp_path / "new" / FILE).read_bytes() == BODY
    assert (tmp_path / "new" / FILE).stat().st_mode & 0o777 == 0o644
    assert [path.name for path in (tmp_path / "new").iterdir()] == [FILE]
    assert all(headers["User-Agent"].startswith("envedit/") for _, headers in there.seen)
    assert [path for path, _ in there.seen] == ["/assets?type=hdris", f"/files/{GOOD}", MAP]


def test_there_is_a_pause_between_requests(there, monkeypatch, tmp_path):
    pauses = []
    monkeypatch.setattr(fetch.time, "sleep", pauses.append)
    get(there, tmp_path)
    assert pauses == [0.25] * 3


def test_a_map_that_is_there_is_left_alone_and_a_changed_one_fetched_again(there, waits, tmp_path):
    get(there, tmp_path)
    there.seen.clear()
    assert get(there, tmp_path) == ([], [FILE], [])
    assert MAP not in [path for path, _ in there.seen]
    (tmp_path / FILE).write_bytes(BODY[:-1] + b"?")
    assert get(there, tmp_path) == ([FILE], [], [])
    assert (tmp_path / FILE).read_bytes() == BODY


@pytest.mark.parametrize(
    ("action", "reason"), [("truncated", "IncompleteRead"), ("silent", "timed out"), ("wrong", "MD5")]
)
def test_a_damaged_file_is_fetched_whole_again_and_never_kept(there, waits, tmp_path, action, reason):
    there.does[MAP] = [action]
    assert get(there, tmp_path)[0] == [FILE]
    assert (tmp_path / FILE).read_bytes() == BODY and waits == [1]
    (tmp_path / FILE).unlink()
    there.does[MAP] = [action] * 9
    fetched, _, failed = get(there, tmp_path)
    assert fetched == [] and len(failed) == 1
    assert GOOD in failed[0] and reason in failed[0] and len(failed[0].splitlines()) == 1
    assert len(there.does[MAP]) == 9 - fetch.WHOLE_TRIES
    assert list(tmp_path.iterdir()) == []


def test_a_file_longer_than_announced_does_not_fill_the_disk(there, waits, tmp_path):
    there.does[MAP] = ["endless"] * 9
    assert f"more than {len(BODY)} bytes" in get(there, tmp_path)[2][0] and list(tmp_path.iterdir()) == []
    assert len(there.does[MAP]) == 8  # no second try


def test_retry_after_is_honoured_in_seconds_and_as_a_date_up_to_ten_minutes(there, waits, tmp_path):
    date = email.utils.formatdate(time.time() + 40, usegmt=True)
    there.does[MAP] = [(429, {"Retry-After": "7"}), (503, {"Retry-After": date})]
    assert get(there, tmp_path)[0] == [FILE]
    assert waits[0] == 7 and 35 < waits[1] < 41
    waits.clear()
    (tmp_path / FILE).unlink()
    there.does[MAP] = [(429, {"Retry-After": "86400"})]
    assert get(there, tmp_path)[0] == [FILE] and waits == [600]


@pytest.mark.parametrize("status", [408, 425, 429, 502])
def test_errors_of_the_server_are_tried_again_with_waits_that_double_and_an_end(
    there, waits, tmp_path, status
):
    there.does[MAP] = [(status, {})] * 50
    _, _, failed = get(there, tmp_path)
    assert waits == [2, 4, 8, 16]  # the first retry is at once
    assert f"HTTP {status}" in failed[0] and len(there.does[MAP]) == 50 - fetch.TRIES
    there.does[MAP] = [(status, {})] * 2
    assert get(there, tmp_path)[0] == [FILE]


def test_a_map_that_cannot_be_had_does_not_stop_the_others(there, waits, tmp_path, capsys):
    names = [f"{i}_puresky" for i in range(5)]
    there.assets = dict.fromkeys(names, {})
    there.bodies = {name: name.encode() * 9 for name in names}
    there.does["/map/1_puresky"] = [(404, {})]
    there.answers["/files/2_puresky"] = b'{"hdri": {"1k": '
    there.answers["/files/3_puresky"] = {"hdri": {"2k": {"hdr": {}}}}
    fetched, _, failed = get(there, tmp_path)
    assert fetched == ["0_puresky_1k.hdr", "4_puresky_1k.hdr"]
    assert capsys.readouterr().err.splitlines() == failed and [line[1:10] for line in failed] == names[1:4]
    for line, words in zip(failed, ("HTTP 404", "not JSON", "no hdr file at 1k"), strict=True):
        assert words in line
    assert waits == []  # nothing that a wait would mend
    assert sorted(path.name for path in tmp_path.iterdir()) == fetched


@pytest.mark.parametrize(
    "slug", ["../../away_puresky", "/tmp/away_puresky", "a\\b_puresky", "..", "", "a\n_puresky"]
)
def test_a_name_that_leads_elsewhere_is_refused(there, waits, tmp_path, slug):
    there.assets = {slug: {"category": "Pure Skies"}, GOOD: {}}
    folder = tmp_path / "deep" / "maps"
    fetched, _, failed = get(there, folder)
    assert fetched == [FILE] and len(failed) == 1 and "refused" in failed[0]
    assert len(failed[0].splitlines()) == 1
    assert sorted(path.name for path in tmp_path.rglob("*") if path.is_file()) == [FILE]
    assert not any("away" in path for path, _ in there.seen)


@pytest.mark.parametrize("change", [
    {"url": "file:///etc/passwd"}, {"url": "ftp://127.0.0.1/x"}, {"url": 7}, {"url": "http://[/x"},
    {"md5": "../../x"}, {"md5": None}, {"size": -1}, {"size": "9"},
    {"size": 0}, {"size": 1 << 40}, {"size": True},
])  # fmt: skip
def test_an_entry_that_makes_no_sense_is_refused(there, waits, tmp_path, change):
    there.answers[f"/files/{GOOD}"] = {"hdri": {"1k": {"hdr": there.entry(GOOD) | change}}}
    fetched, _, failed = get(there, tmp_path)
    assert fetched == [] and len(failed) == 1 and len(failed[0].splitlines()) == 1
    assert list(tmp_path.iterdir()) == [] and waits == []


@pytest.mark.parametrize("answer", [b"{", b"<html>", [], {"hdri": []}, {"hdri": {"1k": []}}, "text", 5])
def test_a_file_list_that_is_none_is_refused(there, waits, tmp_path, answer):
    there.answers[f"/files/{GOOD}"] = answer
    _, _, failed = get(there, tmp_path)
    assert len(failed) == 1 and f"/files/{GOOD}" in failed[0]


@pytest.mark.parametrize("answer", [b"[", [], "x", {}, {"courtyard": {}}])
def test_without_a_list_of_maps_there_is_one_error(there, waits, tmp_path, answer):
    there.answers["/assets"] = answer
    with pytest.raises(fetch.Refused, match="/assets"):
        get(there, tmp_path)


def test_what_is_a_pure_sky(there, waits):
    there.assets |= {"old": {"categories": ["skies", "pure skies"]}, "sky_puresky": None}
    assert fetch.pure_skies(fetch.connected(), there.base) == [GOOD, "old", "sky_puresky"]


def test_nobody_there_is_one_error_after_a_bounded_number_of_tries(waits, tmp_path, monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with StandIn() as gone:
        pass
    with pytest.raises(fetch.Refused, match="refused"):
        get(gone, tmp_path)
    assert waits == [2, 4, 8, 16]


def test_the_command_says_what_it_did_and_exits_by_it(there, waits, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(fetch, "API", there.base)
    assert fetch.main([str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "1 maps fetched, 0 were there, 0 failed" in out and "Powered by Poly Haven" in out
    there.assets["x_puresky"] = {}
    assert fetch.main([str(tmp_path)]) == 1
    assert "x_puresky" in capsys.readouterr().err
    there.answers["/assets"] = []
    assert fetch.main([str(tmp_path)]) == 1
    assert "/assets?type=hdris: got a list" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert fetch.main([str(tmp_path / "file" / "x")]) == 3
    assert "cannot be made" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        fetch.main([])
    assert stop.value.code == 2


def test_without_pooch_one_line_names_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    assert fetch.main([str(tmp_path)]) == 4
    said = capsys.readouterr().err
    assert said.startswith("download_puresky: fetching maps: needs pooch, ") and len(said.splitlines()) == 1
