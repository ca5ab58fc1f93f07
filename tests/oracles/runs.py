"""Whole runs as small as they can be, by the command line and by the pipeline, and what they leave."""

import contextlib
import csv
import json
import signal

import mitsuba as mi
import numpy as np
import pytest

from envedit import config, inputs, pipeline
from envedit.cli import doctor, run
from envedit.export import file_resolution
from envedit.images import images
from tests.oracles.builders import BALL, LIGHT, SENSOR, sky, write_scene

# ---- the command line --------------------------------------------------------------------------------------

FILES = {
    "edited.exr", "render_initial.exr", "render_target.exr", "render_edited.exr", "preview.png",
    "report.html", "history.csv", "config.toml", "manifest.json", "metrics.json", "edited_layers.exr",
    "edited_sky.exr", "edited_lights.exr", "lights.json", "edited.xml", "edited.usda", "look.toml",
}  # fmt: skip
INFLUENCE = {"influence.exr", "influence.png"}
TINY = {
    "input": {"width": 16, "rows": "upper"},
    "scene": {"width": 24},
    "target": {"spp": 16},
    "representation": {"hidden": 16, "depth": 1, "cycles": 4, "turn": False},  # of the default kind
    "fit": {"epochs": 4},
    "optimizer": {"iterations": 4},
    "renderer": {"spp": 32, "max_depth": 3},
    "output": {"spp": 16},
}
SKY = """<default name="map" value="none.exr"/>
    <emitter type="envmap"><string name="filename" value="$map"/></emitter>"""


def merged(*tables):
    """Return tables whose later keys go before earlier ones."""
    found = {}
    for one in tables:
        for name, keys in one.items():
            found[name] = found.get(name, {}) | keys
    return found


def as_toml(tables):
    lines = []
    for table, keys in tables.items():
        lines += [f"[{table}]", *(f"{key} = {config.quote(value)}" for key, value in keys.items())]
    return "\n".join(lines)


def world(folder, rng, **changes):
    """Write a map, a scene and a configuration of a tiny run; returns the configuration's path."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "map.exr").exists():
        images.write_exr(folder / "map.exr", sunny(rng))
    write_scene(folder, SENSOR, BALL, SKY, name="scene.xml")
    given = {"input": {"envmap": "map.exr"}, "scene": {"file": "scene.xml"}}
    (folder / "c.toml").write_text(as_toml(merged(TINY, given, changes)), encoding="utf-8")
    return folder / "c.toml"


def call(path, *arguments):
    return run.main([str(path), *map(str, arguments)])


def changed(**keys):
    """Return the ``--set`` arguments for ``table__key=value``."""
    pairs = [f"{key.replace('__', '.')}={config.quote(value)}" for key, value in keys.items()]
    return [part for pair in pairs for part in ("--set", pair)]


def names(folder):
    """Return the names of what a folder holds; a run that fails before it writes leaves none."""
    return {path.name for path in folder.iterdir()} if folder.exists() else set()


def content(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def pixels(path):
    return images.read(path)[0]


def numbers(value):
    """Yield all numbers of nested lists and dicts."""
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from numbers(item)
    elif isinstance(value, int | float):
        yield value


def no_constant(name):
    raise AssertionError(f"{name} is no JSON")


def measured(folder):
    return json.loads((folder / "metrics.json").read_text(), parse_constant=no_constant)


def rows_of(folder):
    with open(folder / "history.csv", newline="") as file:
        return list(csv.DictReader(file))


@contextlib.contextmanager
def small_world(cache):
    """Keep fits to this test, and do not probe a machine that runs these very tests."""
    level = mi.log_level()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        patch.setattr(doctor, "ensure", lambda variant: None)
        yield
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(level)


def pictures(folder):
    return {name: data for name, data in content(folder).items() if name.endswith((".exr", ".png"))}


def differing(one, other):
    """Name the pictures whose bytes differ; the same are there in both."""
    one, other = pictures(one), pictures(other)
    assert one.keys() == other.keys() and "edited.exr" in one
    return {name for name in one if one[name] != other[name]}


# ---- the pipeline ------------------------------------------------------------------------------------------

WIDTH, HEIGHT = 16, 8


def settings_of(folder, picture, **tables):
    """Return the configuration of a tiny run on a map, which is written; keys by table."""
    images.write_exr(folder / "map.exr", picture)
    write_scene(folder, SENSOR, BALL, LIGHT, name="scene.xml")
    files = {"input": {"envmap": "map.exr"}, "scene": {"file": "scene.xml"}, "optimizer": {"iterations": 20}}
    return config.from_dict(merged(TINY, files, tables), folder)


DARKER = {
    "target": {
        "kind": "strokes",
        "strokes": [{"type": "shadow", "rectangle": [0.0, 0.0, 1.0, 1.0], "amount": 0.5}],
    },
    "renderer": {"spp": 4, "max_depth": 2},
    "optimizer": {"iterations": 3},
}
"""Tables of an edit that asks for half the light."""


def at_both_resolutions(folder, given, **tables):
    """Edit the analytic sky at half its file's size; returns its map, settings, result, and the full map."""
    wide = inputs.read_map(config.Input(envmap="sunsky", width=128), None, 128).radiance
    images.write_exr(folder / "sky.exr", wide, {})
    of_map = {"envmap": "sky.exr", "width": 64} | given
    small = {"input": of_map, "scene": {"width": 8}, "output": {"spp": 4}}
    settings = config.from_dict(small | tables, folder)
    result = pipeline.run(settings)
    return wide, settings, result, file_resolution.at_full_resolution(result)


def interrupting(stage="editing", step=None):
    """Return a Watch that sends Ctrl-C with each progress of a stage, or after one step of it."""
    stages = []

    def progress(done, total, text):
        if stages[-1] == stage and step in (None, done):
            signal.raise_signal(signal.SIGINT)

    return pipeline.Watch(stages.append, progress)


def smooth(rng):
    """Return a map so even that no texel needs a column of its own."""
    return (1 + 0.02 * rng.random((HEIGHT, WIDTH, 3))).astype(np.float32)


def sunny(rng):
    """Return an even sky with a sun, which few explanations need be tried for."""
    picture = 0.05 * sky(rng) + 0.3
    picture[2, 5] = 300
    return picture
