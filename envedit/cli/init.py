"""``envedit init``: write a commented configuration to start from."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

TEMPLATE = """\
# {command}
# Every key and its meaning: envedit/config/schema.py; paths are relative to this file.
preset = "standard"         # draft: a third of the time; paper: the method of the paper, minutes

[input]
envmap = {envmap}           # .hdr or .exr, lat-long; "sunsky": Mitsuba's analytic sky
# azimuth = 90.0            # sunsky: of the sun, degrees
# elevation = 35.0
width = 256                 # working resolution; the result is carried to the file's own

[scene]
file = {scene}              # a Mitsuba XML file, or one of: {shipped}
width = 128                 # of the rendering while editing, pixels
# parameters = {{ roughness = 0.3 }}      # values for the scene's <default>s

[target]
kind = "envmap"             # how the rendering should look: lit by another map,
rotate_degrees = 60.0       # here the same one turned; or file = "another.hdr"
# kind = "image"            # or painted: envedit run {file} --export-initial paint_me.png
# file = "paint_me.png"
# kind = "strokes"          # or as strokes, see docs/painting.md
# strokes = [{{ type = "shadow", polygon = [[0.1, 0.6], [0.4, 0.6], [0.4, 0.9], [0.1, 0.9]] }}]

[representation]
kind = "layers"             # layers | siren | pixels | log-pixels
"""


def main(argv: list[str] | None = None) -> int:
    """Write a configuration; returns the exit code."""
    from envedit.core import shipped

    parser = argparse.ArgumentParser(
        prog="envedit init",
        description="Write a commented configuration to start from.",
        epilog="example: envedit init my_scene.xml --envmap sky.hdr",
    )
    known = ", ".join(shipped.scenes())
    parser.add_argument(
        "scene", metavar="SCENE", nargs="?", default="sphere", help=f"Mitsuba XML file, or one of: {known}"
    )
    parser.add_argument(
        "--envmap", metavar="MAP", default="sunsky", help="EXR or Radiance HDR (default: sunsky)"
    )
    parser.add_argument(
        "--out", metavar="FILE", default="edit.toml", help="file to write (default: edit.toml)"
    )
    arguments = parser.parse_args(argv)
    from envedit.core.errors import EnveditError

    try:
        _write(arguments, known)
    except EnveditError as error:
        print(f"envedit: {error}", file=sys.stderr)
        return error.exit_code
    print(f"{arguments.out}: written; next: envedit run {arguments.out}")
    return 0


def _write(arguments, known):
    from envedit import config
    from envedit.core import shipped
    from envedit.core.atomic_files import write_atomically
    from envedit.core.errors import ConfigError, InputError

    file = Path(arguments.out)
    if os.path.lexists(file):
        raise ConfigError(f"{file}: exists already; remove it, or give another name with --out")

    def named(value, bare):
        if value in bare:
            return config.quote(value)
        if not os.path.isfile(value):
            raise InputError(f"{value}: no such file; give a file, or one of {', '.join(bare)}")
        return config.quote(os.path.relpath(value, file.parent))

    text = TEMPLATE.format(
        command=f"envedit run {file.name}",
        file=file.name,
        envmap=named(arguments.envmap, ("sunsky",)),
        scene=named(arguments.scene, shipped.scenes()),
        shipped=known,
    )
    config.loads(text, file.absolute().parent, str(file))
    write_atomically(file, text.encode())
