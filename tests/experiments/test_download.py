"""Fetching PureSky maps, with a stand-in for pooch's downloads that misbehaves."""

import hashlib
import os
import re
import sys
import types
from pathlib import Path

import pooch
import pytest
import requests

from experiments import download_puresky as fetch
from experiments import puresky
from tests.oracles import ROOT

BODY = bytes(range(256)) * 400
FILE = "north_field_puresky_1k.hdr"


@pytest.fixture
def there(monkeypatch):
    """What was asked for, with its headers, and in ``does`` how the next requests end."""
    there = types.SimpleNamespace(seen=[], does=[])

    def downloader(headers, timeout):
        def download(url, output_file, pooch):
            there.seen.append((url, headers["User-Agent"]))
            action = there.does.pop(0) if there.does else "fine"
            if action == "503" or not url.endswith(FILE):
                raise requests.HTTPError("503" if action == "503" else "404")
            body = {"fine": BODY, "wrong": BODY[:-1] + b"!", "truncated": BODY[:-1000]}[action]
            Path(output_file).write_bytes(body)

        return download

    monkeypatch.setattr(fetch, "MAPS", {"north_field": hashlib.md5(BODY).hexdigest()})
    monkeypatch.setattr(pooch, "HTTPDownloader", downloader)
    monkeypatch.setattr(pooch.core, "time", types.SimpleNamespace(sleep=lambda seconds: None))
    return there


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
    ((url, agent),) = there.seen
    assert url == fetch.ADDRESS + FILE and agent.startswith("envedit/")
    assert fetch.download(tmp_path) == [] and len(there.seen) == 1
    (tmp_path / FILE).write_bytes(BODY[:-1] + b"?")
    assert fetch.download(tmp_path) == []
    assert (tmp_path / FILE).read_bytes() == BODY


@pytest.mark.parametrize(("action", "reason"), [("truncated", "MD5"), ("wrong", "MD5"), ("503", "503")])
def test_a_damaged_file_is_fetched_whole_again_and_never_kept(there, tmp_path, action, reason):
    there.does = [action]
    assert fetch.download(tmp_path) == []
    assert (tmp_path / FILE).read_bytes() == BODY
    (tmp_path / FILE).unlink()
    there.does = [action] * 9
    (line,) = fetch.download(tmp_path)
    assert line.startswith(FILE) and reason in line
    assert len(there.does) == 9 - fetch.TRIES
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
