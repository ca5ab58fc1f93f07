"""Fetching PureSky maps from a stand-in for Poly Haven that misbehaves."""

import contextlib
import email.utils
import hashlib
import http.server
import json
import re
import threading
import time
import urllib.parse

import pytest

from envedit.core.errors import InputError
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
        here, asked = self.server, urllib.parse.urlsplit(self.path)
        here.seen.append((self.path, dict(self.headers)))
        doing = here.does.get(asked.path, [])
        action = doing.pop(0) if doing else "fine"
        if isinstance(action, tuple):  # status and headers
            self.send_response(action[0])
            for name, value in action[1].items():
                self.send_header(name, value)
            self.end_headers()
        elif asked.path.startswith("/map/"):
            self.map(here.bodies[asked.path.removeprefix("/map/")], action)
        else:
            document = here.document(asked.path)
            text = document if isinstance(document, bytes) else json.dumps(document).encode()
            self.send_response(200 if document is not None else 404)
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text[: len(text) // 2] if action == "truncated" else text)

    def map(self, body, action):
        first = int(self.headers.get("Range", "bytes=0-")[6:-1])
        ranged = "Range" in self.headers and action != "no ranges"
        if ranged:
            self.send_response(206)
            shown = first + 5 if action == "other range" else first
            self.send_header("Content-Range", f"bytes {shown}-{len(body) - 1}/{len(body)}")
            body = body[first:]
        else:
            self.send_response(200)
        if action == "wrong":
            body = body[:-1] + b"!"
        if action == "endless":
            body = body * 50
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if action == "truncated":
            self.wfile.write(body[: len(body) // 2])
        elif action == "silent":
            self.wfile.write(body[:1000])
            self.wfile.flush()
            time.sleep(0.8)
        elif action == "trickle":
            with contextlib.suppress(OSError):
                for i in range(100):
                    self.wfile.write(body[i : i + 1])
                    self.wfile.flush()
                    time.sleep(0.02)
        else:
            self.wfile.write(body)


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
def connection():
    """A connection that does not wait but remembers how long it would have."""
    waits = []
    said = []
    made = fetch.Connection(pause=0.25, timeout=0.3, sleep=waits.append, say=said.append)
    made.waits, made.said = waits, said
    return made


def waited(connection):
    return [wait for wait in connection.waits if wait != 0.25]


def get(there, connection, folder, **options):
    return fetch.download(folder, base=there.base, connection=connection, **options)


FILE = f"{GOOD}_1k.hdr"
MAP = f"/map/{GOOD}"


def test_maps_of_the_category_are_fetched_and_listed(there, connection, tmp_path):
    fetched, present, failed = get(there, connection, tmp_path / "new")
    assert (fetched, present, failed) == ([FILE], [], [])
    assert (tmp_path / "new" / FILE).read_bytes() == BODY
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["MANIFEST.tsv", FILE]
    header, row = (tmp_path / "new" / "MANIFEST.tsv").read_text().splitlines()
    assert header == "file\tmd5\tsource\tlicence"
    assert row.split("\t") == [FILE, hashlib.md5(BODY).hexdigest(), there.base + MAP, "CC0 1.0"]
    assert all(headers["User-Agent"].startswith("envedit/") for _, headers in there.seen)
    assert [path for path, _ in there.seen] == [
        "/assets?type=hdris&category=pure-skies", f"/files/{GOOD}", MAP,
    ]  # fmt: skip
    assert connection.waits == [0.25] * 2  # between requests, not before the first


def test_a_map_that_is_there_is_left_alone_and_a_changed_one_fetched_again(there, connection, tmp_path):
    get(there, connection, tmp_path)
    there.seen.clear()
    assert get(there, connection, tmp_path) == ([], [FILE], [])
    assert MAP not in [path for path, _ in there.seen]
    (tmp_path / FILE).write_bytes(BODY[:-1] + b"?")
    assert get(there, connection, tmp_path) == ([FILE], [], [])
    assert (tmp_path / FILE).read_bytes() == BODY


def test_what_was_cut_short_is_continued(there, connection, tmp_path):
    there.does[MAP] = ["truncated"]
    assert get(there, connection, tmp_path)[0] == [FILE]
    assert (tmp_path / FILE).read_bytes() == BODY
    ranges = [headers.get("Range") for path, headers in there.seen if path == MAP]
    assert ranges == [None, f"bytes={len(BODY) // 2}-"]
    assert waited(connection) == [1.0]


def test_a_part_of_an_earlier_call_is_continued(there, connection, tmp_path):
    (tmp_path / f"{FILE}.part").write_bytes(BODY[:70000])
    assert get(there, connection, tmp_path)[0] == [FILE]
    assert there.seen[-1][1]["Range"] == "bytes=70000-"
    assert (tmp_path / FILE).read_bytes() == BODY
    assert not (tmp_path / f"{FILE}.part").exists()


def test_a_part_of_another_file_is_thrown_away(there, connection, tmp_path):
    (tmp_path / f"{FILE}.part").write_bytes(b"x" * 70000)
    assert get(there, connection, tmp_path)[0] == [FILE]
    assert (tmp_path / FILE).read_bytes() == BODY


@pytest.mark.parametrize(
    ("action", "reason"),
    [("no ranges", None), ("other range", "another range"), ((416, {}), "does not continue")],
)
def test_a_server_that_does_not_continue_starts_anew(there, connection, tmp_path, action, reason):
    (tmp_path / f"{FILE}.part").write_bytes(BODY[:500])
    there.does[MAP] = [action]
    assert get(there, connection, tmp_path)[0] == [FILE]
    assert (tmp_path / FILE).read_bytes() == BODY
    assert len(connection.said) == (reason is not None) and (reason or "") in "".join(connection.said)


@pytest.mark.parametrize(("action", "reason"), [("silent", "timed out"), ("trickle", r"\d+ bytes in 0 s")])
def test_a_slow_server_is_left_and_asked_for_the_rest(there, connection, tmp_path, action, reason):
    there.does[MAP] = [action]
    assert get(there, connection, tmp_path)[0] == [FILE]
    assert (tmp_path / FILE).read_bytes() == BODY
    ranges = [headers.get("Range") for path, headers in there.seen if path == MAP]
    assert len(ranges) == 2 and ranges[1] is not None
    assert waited(connection) == [1.0] and re.search(reason, connection.said[0])


def test_a_wrong_hash_is_tried_once_more_and_never_kept(there, connection, tmp_path):
    there.does[MAP] = ["wrong"]
    assert get(there, connection, tmp_path)[0] == [FILE]
    (tmp_path / FILE).unlink()
    there.does[MAP] = ["wrong"] * 9
    fetched, _, failed = get(there, connection, tmp_path)
    assert fetched == [] and len(failed) == 1
    assert GOOD in failed[0] and "MD5" in failed[0] and len(failed[0].splitlines()) == 1
    assert len(there.does[MAP]) == 7
    assert [path.name for path in tmp_path.iterdir()] == ["MANIFEST.tsv"]


def test_a_file_longer_than_announced_does_not_fill_the_disk(there, connection, tmp_path):
    there.does[MAP] = ["endless"] * 9
    told = []
    entry = there.entry(GOOD)
    with pytest.raises(fetch.Refused, match="MD5"):
        connection.file(entry["url"], tmp_path / FILE, entry["size"], entry["md5"], told.append)
    assert max(told) <= len(BODY) + (1 << 16)
    assert list(tmp_path.iterdir()) == []


def test_retry_after_is_honoured_in_seconds_and_as_a_date(there, connection, tmp_path):
    date = email.utils.formatdate(time.time() + 40, usegmt=True)
    there.does[MAP] = [(429, {"Retry-After": "7"}), (503, {"Retry-After": date})]
    assert get(there, connection, tmp_path)[0] == [FILE]
    first, second = waited(connection)
    assert first == 7 and 35 < second < 41


def test_a_server_that_wants_too_long_a_wait_is_left(there, connection, tmp_path):
    there.does[MAP] = [(429, {"Retry-After": "86400"})]
    _, _, failed = get(there, connection, tmp_path)
    assert "86400 s" in failed[0] and waited(connection) == []


def test_errors_of_the_server_are_tried_again_with_waits_that_double_and_an_end(there, connection, tmp_path):
    there.does[MAP] = [(500, {})] * 2
    assert get(there, connection, tmp_path)[0] == [FILE]
    assert waited(connection) == [1, 2]
    (tmp_path / FILE).unlink()
    connection.waits.clear()
    there.does[MAP] = [(502, {})] * 50
    _, _, failed = get(there, connection, tmp_path)
    assert waited(connection) == [1, 2, 4, 8, 16]
    assert "502" in failed[0] and f"after {fetch.TRIES} tries" in failed[0]
    assert len(there.does[MAP]) == 50 - fetch.TRIES


def test_a_map_that_cannot_be_had_does_not_stop_the_others(there, connection, tmp_path):
    names = [f"{i}_puresky" for i in range(5)]
    there.assets = dict.fromkeys(names, {})
    there.bodies = {name: name.encode() * 9 for name in names}
    there.does["/map/1_puresky"] = [(404, {})]
    there.answers["/files/2_puresky"] = b'{"hdri": {"1k": '
    there.answers["/files/3_puresky"] = {"hdri": {"2k": {"hdr": {}}}}
    told = []
    fetched, _, failed = get(there, connection, tmp_path, say=told.append)
    assert fetched == ["0_puresky_1k.hdr", "4_puresky_1k.hdr"]
    assert told == failed and [line[1:10] for line in failed] == names[1:4]
    for line, words in zip(failed, ("HTTP 404", "not JSON", "offered: 2k"), strict=True):
        assert words in line
    assert waited(connection) == []  # nothing that a wait would mend
    rows = (tmp_path / "MANIFEST.tsv").read_text().splitlines()[1:]
    assert [row.split("\t")[0] for row in rows] == fetched


@pytest.mark.parametrize(
    "slug", ["../../away_puresky", "/tmp/away_puresky", "a\\b_puresky", "..", "", "a\n_puresky"]
)
def test_a_name_that_leads_elsewhere_is_refused(there, connection, tmp_path, slug):
    there.assets = {slug: {"category": "Pure Skies"}, GOOD: {}}
    folder = tmp_path / "deep" / "maps"
    fetched, _, failed = get(there, connection, folder)
    assert fetched == [FILE] and len(failed) == 1 and "refused" in failed[0]
    assert len(failed[0].splitlines()) == 1
    assert sorted(path.name for path in tmp_path.rglob("*") if path.is_file()) == ["MANIFEST.tsv", FILE]
    assert not any("away" in path for path, _ in there.seen)


@pytest.mark.parametrize(
    "change",
    [
        {"url": "file:///etc/passwd"}, {"url": "ftp://127.0.0.1/x"}, {"url": 7}, {"url": "http://[/x"},
        {"url": "http://127.0.0.1:1/a b"}, {"md5": "../../x"}, {"md5": None}, {"size": -1}, {"size": "9"},
        {"size": 0}, {"size": 1 << 40}, {"size": True},
    ],
)  # fmt: skip
def test_an_entry_that_makes_no_sense_is_refused(there, connection, tmp_path, change):
    there.answers[f"/files/{GOOD}"] = {"hdri": {"1k": {"hdr": there.entry(GOOD) | change}}}
    fetched, _, failed = get(there, connection, tmp_path)
    assert fetched == [] and len(failed) == 1 and len(failed[0].splitlines()) == 1
    assert list(tmp_path.iterdir()) == [] and waited(connection) == []


@pytest.mark.parametrize("answer", [b"{", b"<html>", [], {"hdri": []}, {"hdri": {"1k": []}}, "text", 5])
def test_a_file_list_that_is_none_is_refused(there, connection, tmp_path, answer):
    there.answers[f"/files/{GOOD}"] = answer
    _, _, failed = get(there, connection, tmp_path)
    assert len(failed) == 1 and f"/files/{GOOD}" in failed[0]


@pytest.mark.parametrize("answer", [b"[", [], "x", {}, {"courtyard": {}}])
def test_without_a_list_of_maps_there_is_one_error(there, connection, tmp_path, answer):
    there.answers["/assets"] = answer
    with pytest.raises(fetch.Refused, match="/assets"):
        get(there, connection, tmp_path)


def test_a_list_that_was_cut_short_is_asked_for_again(there, connection, tmp_path):
    there.does["/assets"] = ["truncated"]
    assert get(there, connection, tmp_path)[0] == [FILE]
    assert waited(connection) == [1.0]


def test_an_api_that_does_not_know_the_category_is_asked_for_everything(there, connection, tmp_path):
    there.does["/assets"] = [(400, {})]
    there.assets |= {"old": {"categories": ["skies", "pure skies"]}, "sky_puresky": None}
    assert fetch.pure_skies(connection, there.base) == [GOOD, "old", "sky_puresky"]
    assert there.seen[-1][0] == "/assets?type=hdris"


def test_nobody_there_is_one_error_after_a_bounded_number_of_tries(connection, tmp_path, monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with StandIn() as gone:
        base = gone.base
    with pytest.raises(fetch.Refused, match=f"after {fetch.TRIES} tries"):
        fetch.download(tmp_path, base=base, connection=connection)


def test_the_manifest_keeps_what_other_calls_fetched_and_nothing_else_is_overwritten(
    there, connection, tmp_path
):
    there.bodies["b_puresky"], there.assets["b_puresky"] = b"b" * 99, {}
    get(there, connection, tmp_path, limit=1)
    assert len((tmp_path / "MANIFEST.tsv").read_text().splitlines()) == 2
    get(there, connection, tmp_path)
    rows = (tmp_path / "MANIFEST.tsv").read_text().splitlines()[1:]
    assert [row.split("\t")[0] for row in rows] == ["b_puresky_1k.hdr", FILE]
    other = "file\tsha256\nx\ty\n"
    (tmp_path / "MANIFEST.tsv").write_text(other)
    with pytest.raises(InputError, match="not a manifest"):
        get(there, connection, tmp_path)
    assert (tmp_path / "MANIFEST.tsv").read_text() == other


def test_the_command_says_what_it_did_and_exits_by_it(there, tmp_path, capsys):
    ask = [str(tmp_path), "--base-url", f"{there.base}/", "--pause", "0", "--timeout", "5"]
    assert fetch.main(ask) == 0
    out = capsys.readouterr().out
    assert "1 maps fetched, 0 were there, 0 failed" in out and "Powered by Poly Haven" in out
    there.assets["x_puresky"] = {}
    assert fetch.main([*ask, "--quiet"]) == 1
    said = capsys.readouterr()
    assert said.out == "" and len(said.err.splitlines()) == 1 and "x_puresky" in said.err
    there.answers["/assets"] = []
    assert fetch.main(ask) == 1
    assert "/assets: came a list" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert fetch.main([str(tmp_path / "file" / "x"), *ask[1:]]) == 3
    assert "cannot be used" in capsys.readouterr().err


@pytest.mark.parametrize(
    "wrong", [["--resolution", "../1k"], ["--limit", "0"], ["--pause", "-1"], ["--timeout", "nan"]]
)
def test_usage(wrong, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        fetch.main([str(tmp_path), *wrong])
    assert stop.value.code == 2 and wrong[0] in capsys.readouterr().err
