"""Time the commands on a map alone, and their peak memory, on three public maps and on one of 8192 x 4096."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

import envedit
from envedit.core import latlong
from envedit.images import images
from experiments import puresky
from experiments.harness import Done, Experiment, calling
from experiments.summary import Summary
from experiments.tradeoff import cost

LARGE = 8192
"""Columns of the large map, an enlarged small one."""
CLIPPED_AT = 10.0
"""Radiance at which a map is clipped for ``unclip``."""
LOOK = Path(__file__).parents[1] / "looks" / "evening.toml"
COMMANDS = {
    "lights": "lights {first}",
    "adjust, rotation and colour": "adjust {first} --horizon 5 --tilt 3 --exposure 1 --saturation 0.8",
    "adjust, bound of radiance": "adjust {first} --max-radiance 50",
    "adjust, blur": "adjust {first} --blur 5",
    "sky": "sky --elevation 30 --width {width}",
    "blend": "blend {first} {second} --amount 0.5",
    "compare": "compare {first} {second}",
    "apply": "apply {look} {first}",
    "unclip": "unclip {clipped}",
}
"""What is run, by its name in the table."""


def cases(given):
    files = [puresky.file(name) for name in ("kloofendal_48d_partly_cloudy", "evening_road_01")]
    files.append(str(puresky.data() / "hdri" / "studio_small_03_1k.hdr"))
    found = []
    for name, line in COMMANDS.items():
        some = files[:1] if name == "sky" else files
        found += [case(name, line, file, files[k - 1], None) for k, file in enumerate(some)]
        found.append(case(name, line, files[0], files[1], LARGE))
    return found


def case(name, line, first, second, width):
    """Return the case of a command on two files, enlarged where there is a width."""
    tables = {"input": {"envmap": first}, "target": {"kind": "envmap", "file": second}}
    size = f"{LARGE} x {LARGE // 2}" if width else "1024 x 512"
    about = {"command": name, "size": size, "map": Path(first).stem}
    title = f"{name.replace(', ', '-').replace(' ', '_')}-{Path(first).stem}-{width or 1024}"
    return calling(title, timed, tables, about, line=line, width=width)


def timed(settings, folder: Path, line: str, width: int | None) -> dict:
    """Run a command in a process of its own; returns its cost, as :func:`.cost.main`."""
    files = [settings.input.envmap, settings.target.file]
    if width:
        files = [enlarged(file, folder.parent / f"{Path(file).stem}_{width}.exr", width) for file in files]
    names = {"first": files[0], "second": files[1], "width": str(width or 1024), "look": str(LOOK)}
    if "{clipped}" in line:
        envmap, _ = images.load_envmap(files[0])
        names["clipped"] = str(folder / "clipped.exr")
        images.write_exr(names["clipped"], np.minimum(envmap, CLIPPED_AT))
        del envmap
    command = [sys.executable, "-m", "envedit", *(part.format(**names) for part in line.split()), "--json"]
    environment = os.environ | {"PYTHONPATH": str(Path(envedit.__file__).parents[1])}
    return cost.measured(command, folder, cwd=folder, env=environment, stdout=subprocess.DEVNULL)


def enlarged(file: str, to: Path, width: int) -> str:
    """Write a map enlarged, unless it is there; returns the file."""
    if not to.exists():
        envmap, _ = images.load_envmap(file)
        images.write_exr(to, latlong.resize(envmap, width // 2, width))
    return str(to)


def measure(done: Done) -> dict:
    return done.metrics | {"megabytes": done.metrics["peak_bytes"] / 2**20}


EXPERIMENT = Experiment(
    cases,
    measure,
    summary=Summary(
        {"command": "{command}", "map": "{size}"},
        {
            "maps": "{runs}",
            "seconds": "{wall_s.max:.1f}",
            "seconds of all cores": "{cpu_s.max:.1f}",
            "peak memory, MB": "{megabytes.max:.0f}",
        },
    ),
    alone=True,
)
