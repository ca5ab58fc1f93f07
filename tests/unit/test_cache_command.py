"""``envedit cache``: sizes of what is kept, emptied without touching anything else."""

import numpy as np
import pytest

from envedit.cli import cache
from envedit.core.array_cache import DiskCache, cache_folder


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "envedit"


def keep(kind, count, floats):
    store = DiskCache(cache_folder(kind))
    for index in range(count):
        store.store({"number": index}, {"a": np.zeros(floats, np.float32)})
    return store.files()


def lines(capsys, *arguments, code=0):
    assert cache.main([*arguments]) == code
    return capsys.readouterr().out.splitlines()


def test_nothing_kept(home, capsys):
    said = lines(capsys)
    kinds = "transport", "fits", "renderings", "usd"
    assert [line.split(": ")[0] for line in said[:4]] == [f"{home}/{kind}" for kind in kinds]
    assert all(line.endswith("0 entries, 0.0 MB") for line in said[:4]) and not home.exists()
    assert lines(capsys, "--empty")[0].endswith("0 entries, 0.0 MB deleted") and not home.exists()


def test_entries_and_sizes(home, capsys):
    files = keep("transport", 2, 1_000_000) + keep("fits", 1, 250_000)
    said = lines(capsys)
    assert said[0].endswith("2 entries, 8.0 MB") and said[1].endswith("1 entry, 1.0 MB")
    assert len(files) == 3 and all(file.is_file() for file in files)
    files = keep("transport", 2, 10) + keep("fits", 1, 10)
    scene = home / "usd" / "0" / "converted.json"
    scene.parent.mkdir(parents=True)
    scene.write_text("{}")
    name = "0" * 32 + ".arrays"
    names = "doctor-0123456789abcdef.json", "transport/notes.txt", f"transport/{name}.bak"
    foreign = [home / one for one in (*names, f"fits/more/{name}", f"others/{name}")]
    for file in foreign:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("mine")
    said = lines(capsys, "--empty")
    counts = "2 entries", "1 entry", "0 entries", "1 entry", "0 entries"
    assert [line.rsplit(": ", 1)[1] for line in said] == [f"{count}, 0.0 MB deleted" for count in counts]
    assert not any(file.exists() for file in files)
    assert all(file.read_text() == "mine" for file in foreign)
    assert lines(capsys)[0].endswith("0 entries, 0.0 MB")


@pytest.mark.parametrize("what", ["unlink", "iterdir"])
def test_what_cannot_be_deleted_or_read_is_named(what, home, capsys, monkeypatch):
    file = keep("transport", 1, 10)[0]

    def refuse(self, *_):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(type(file), what, refuse)
    assert cache.main(["--empty"]) == 3
    err = capsys.readouterr().err
    where = file if what == "unlink" else file.parent
    assert err == f"envedit: {where}: Permission denied; check its permissions\n" and file.is_file()
