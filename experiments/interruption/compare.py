"""What a killed run left, and how the files of a resumed one differ from those of an undisturbed one."""

import csv
import json
import re
import zipfile
from pathlib import Path

import numpy as np

ROWS = (
    r"<tr><td>(?:(?:fit|transport) seconds|(?:fit|light transport \(T\)) taken from disk)</td>"
    r"<td>.*?</td></tr>"
)
"""Of a report: what a cache changes."""
TIMES = r"\d{4}-\d\d-\d\dT[\d:+]+|\b[\d.]+ m?s\b|width:[\d.]+rem"
"""Of a text: dates, seconds and their bars."""


def look(folder: Path, reference: Path) -> dict:
    """Describe a killed run's folder: step of its checkpoint, files, temporary files, those half written.

    A file counts as half written if it cannot be read or differs from an undisturbed run's. Only the
    checkpoint and the preview, which is drawn anew as the edit goes on, need no more than to be complete.
    """
    found = {"step": None, "files": 0, "temporary": 0, "half": []}
    for path in folder.iterdir() if folder.exists() else ():
        if path.name.startswith("."):
            found["temporary"] += 1
            continue
        found["files"] += 1
        try:
            if path.name == "checkpoint.npz":
                with open(path, "rb") as file, np.load(file) as stored:
                    found["step"] = json.loads(stored["meta"].tobytes())["state"]["step"]
                    whole = all(stored[key] is not None for key in stored.files)
            elif path.name == "preview.png":
                whole = path.read_bytes().endswith(b"IEND\xaeB`\x82")
            else:
                whole = same(path.name, folder, reference)
        except (ValueError, OSError, KeyError, EOFError, zipfile.BadZipFile):
            whole = False
        found["half"] += [] if whole else [path.name]
    return found


def differing(folder: Path, reference: Path) -> list[str]:
    """Name the files that differ from an undisturbed run's: by their bytes, but for times and folder."""
    names = [{path.name for path in one.iterdir()} for one in (folder, reference)]
    both = names[0] & names[1]
    return sorted((names[0] ^ names[1]) | {name for name in both if not same(name, folder, reference)})


def same(name: str, *folders: Path) -> bool:
    """Return whether a file is the same in two folders."""
    first, second = (compared(folder / name, folders) for folder in folders)
    return first == second


def compared(path: Path, folders: tuple[Path, ...]):
    """Return what must be the same in a file: all of it but times, folders, and what a cache changes."""
    if path.name == "metrics.json":
        return measured(path)
    if path.name == "history.csv":
        with open(path, newline="") as file:
            return [{key: row[key] for key in row if key != "step_ms"} for row in csv.DictReader(file)]
    if path.suffix in (".toml", ".json", ".html"):
        text = path.read_text()
        for folder in folders:
            text = text.replace(str(folder), "FOLDER")
        return re.sub(TIMES, "TIME", re.sub(ROWS, "", text))
    return path.read_bytes()


def measured(path: Path) -> dict:
    """Return metrics without the times and what a cache changes."""
    found = json.loads(path.read_text())
    for part in ("fit", "transport"):
        for key in ("cached", "seconds"):
            (found[part] or {}).pop(key, None)
    return {key: value for key, value in found.items() if key != "timing"}
