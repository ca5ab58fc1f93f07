"""``envedit apply LOOK [LOOK] MAP ...``: maps in the light of an edit."""

from __future__ import annotations

import os
from pathlib import Path

from envedit.cli import doctor, map_command
from envedit.core.atomic_files import make_folder
from envedit.core.errors import ConfigError, counted

LOOK = ".toml"


def main(argv: list[str] | None = None) -> int:
    """Apply looks to maps; returns the exit code."""
    parser = map_command.make_parser(
        "apply",
        "Give maps the light of an edit: key light, fill and rim, gain and colours of the sky, as look.toml\n"
        "of a run has them. Each result has the name, size, format and colours of its map.",
        [
            "envedit apply run/look.toml skies/*.exr --out evening",
            "envedit apply run/look.toml sky.hdr --amount 0.5",
            "envedit apply noon.toml dusk.toml sky.exr --frames 48 --out frames",
        ],
        out="DIR",
        default="LOOK_applied",
    )
    parser.add_argument(
        "files", metavar="FILE", nargs="+", help="one look, or two to go between (.toml), and maps"
    )
    parser.add_argument(
        "--amount",
        type=map_command.number(0, 1),
        help="0: the map, or the first of two looks; 1 (default): the look",
    )
    parser.add_argument("--frames", type=int, help="write so many maps, from amount 0 to 1")
    return map_command.run(parser, argv, _apply)


def _apply(arguments, console):
    from envedit.maps import look_transfer, looks

    # ---- What is asked
    names = [file for file in arguments.files if file.lower().endswith(LOOK)]
    maps = [file for file in arguments.files if file not in names]
    amounts = _amounts(arguments, names, maps)
    folder = Path(arguments.out or f"{Path(names[-1]).stem}_applied")
    files = [_files(folder, source, len(amounts)) for source in maps]
    _check(files)
    selected = [looks.read(name) for name in names]
    start = selected[0] if len(selected) == 2 else None

    # ---- Map by map, each read once
    doctor.select()
    light = " to ".join(names)
    console.facts["files"] = []
    for source, targets in zip(maps, files, strict=True):
        input_map = map_command.read(source, arguments, console)
        make_folder(folder)
        for amount, path in zip(amounts, targets, strict=True):
            edited = look_transfer.apply(input_map.radiance, selected[-1], amount, start)
            map_command.write(path, input_map.as_stored(edited), input_map, console)
            console.facts["files"].append({"map": source, "file": str(path), "amount": amount})
            console.say(f"{path}: {source} in the light of {light}, amount {amount:.3g}")


def _amounts(arguments, names, maps):
    """Return the amounts of the maps that are written of each map."""
    amount, frames = arguments.amount, arguments.frames
    if not 1 <= len(names) <= 2 or not maps:
        found = counted(len(names), "look (.toml)", "looks (.toml)")
        got = f"{found} and {counted(len(maps), 'map', 'maps')}"
        raise ConfigError(f"got {got}, expected one look, or two, and maps")
    if amount is not None and frames is not None:
        raise ConfigError("got --amount and --frames, expected one of them")
    if frames is not None and not 2 <= frames <= 9999:
        raise ConfigError(f"--frames: got {frames}, expected 2 to 9999")
    if len(names) == 2 and amount is None and frames is None:
        raise ConfigError("got two looks: say where between them, with --amount or --frames")
    if frames is not None:
        return [i / (frames - 1) for i in range(frames)]
    return [1.0 if amount is None else amount]


def _files(folder, source, count):
    """Return the files that are written of a map."""
    name = Path(source)
    ending = ".hdr" if name.suffix.lower() == ".hdr" else ".exr"
    if count == 1:
        return [folder / f"{name.stem}{ending}"]
    return [folder / f"{name.stem}_{i + 1:04d}{ending}" for i in range(count)]


def _check(files):
    """Refuse to write a file twice, or one that is there."""
    written = set()
    for path in (path for targets in files for path in targets):
        if path in written:
            raise ConfigError(f"{path}: two maps have this name: apply the look to one at a time")
        if os.path.lexists(path):
            raise ConfigError(f"{path}: exists already: give another folder with --out")
        written.add(path)
