"""``envedit init``: write a commented configuration to start from."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

from envedit.cli.console import Console, exit_code, make_parser
from envedit.core import shipped
from envedit.core.errors import ConfigError, InputError

TEMPLATE = """\
# envedit run {name}
# All keys with their meaning: envedit schema --markdown. Paths are relative to this file.
preset = "standard"  # or "draft", two fifths of the time; "paper", that of D'Orazio et al.

[input]
envmap = {envmap}  # EXR or Radiance HDR, lat-long; "scene", its own; "sunsky", analytic; "auto"
# azimuth = 90.0  # sunsky: of the sun, degrees
# elevation = 35.0  # sunsky: of the sun above the horizon, degrees
width = 256  # texels while editing; afterwards the edit is carried to the size of the file

[scene]
file = {scene}  # a Mitsuba XML or USD file, or one of {shipped}
width = 128  # of the rendering while editing, pixels
# parameters = {{ roughness = 0.3 }}  # values for the <default>s of the scene

# The target: how the rendering should look. Choose one of three: uncomment its lines, and delete the others.
[target]
kind = "envmap"  # 1. lit by another map:
rotate_degrees = 60.0  # the same one, turned about the vertical; or file = "another.hdr"
# kind = "image"  # 2. painted, on what "envedit run {name} --export-initial paint_me.png" writes
# file = "paint_me.png"
# kind = "strokes"  # 3. strokes, in fractions of the picture, as in the shipped edits/warmer
# strokes = [{{ type = "shadow", ellipse = [0.6, 0.8, 0.1, 0.05] }}]

[representation]
kind = "layers"  # or "siren", the paper's; "pixels"; "log-pixels"
"""


def main(argv: list[str] | None = None) -> int:
    """Write a configuration; returns the exit code."""
    scenes = ", ".join(shipped.scenes())
    parser = make_parser(
        "init",
        "Write a commented configuration to start from.",
        ["envedit init", "envedit init my_scene.xml --envmap sky.hdr --out my_edit.toml"],
        f"shipped scenes: {scenes}",
    )
    parser.add_argument(
        "scene",
        metavar="SCENE",
        nargs="?",
        default="sphere",
        help="a Mitsuba XML or USD file, or the name of a shipped scene (default: sphere)",
    )
    parser.add_argument(
        "--envmap",
        metavar="MAP",
        default="auto",
        help="an EXR or Radiance HDR file; scene, the one that the scene names; sunsky, Mitsuba's analytic "
        "sky; or auto, the scene's if it names one (default: auto)",
    )
    parser.add_argument(
        "--out", metavar="FILE", default="edit.toml", help="file to write (default: edit.toml)"
    )
    arguments = parser.parse_args(argv)
    return exit_code(Console(), lambda: _write(arguments))


def _write(arguments):
    from envedit import config
    from envedit.config import presets
    from envedit.core.atomic_files import write_atomically

    file = Path(arguments.out)
    if os.path.lexists(file):
        raise ConfigError(f"{file}: exists already; delete it, or give another name with --out")
    kind = "an EXR or Radiance HDR file"
    envmap = _file_name("--envmap", arguments.envmap, presets.MAP_WORDS, kind, file.parent)
    scene = _file_name("SCENE", arguments.scene, shipped.scenes(), "a Mitsuba XML or USD file", file.parent)
    text = TEMPLATE.format(
        name=file.name,
        envmap=config.quote(envmap),
        scene=config.quote(scene),
        shipped=", ".join(shipped.scenes()),
    )
    config.loads(text, file.absolute().parent, str(file))
    write_atomically(file, text.encode())
    print(f"{arguments.out}: written; edit it, then: envedit run {shlex.quote(arguments.out)}")
    return 0


def _file_name(option, value, names, kind, folder):
    """Return what a configuration in a folder calls a file: a bare name as it is, a path relative to it."""
    from envedit.config.validators import meant

    if value in names:
        return value
    if not os.path.isfile(value):
        hint = meant(value, names, "check the path")
        raise InputError(
            f"{option}: got {value}: no such file; expected {kind}, or {', '.join(names)}; {hint}"
        )
    return os.path.relpath(value, folder)
