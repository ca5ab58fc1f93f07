"""Skies that were turned: over several runs, and where noise hides the turn."""

import numpy as np
import pytest

import envedit
from envedit import config
from envedit.core import latlong
from envedit.images import analytic_sky, images
from tests.oracles import runs
from tests.oracles.builders import write_scene

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_core")]

CLOUDS = 12
TORUS = """<sensor type="perspective"><float name="fov" value="35"/>
<transform name="to_world"><lookat origin="0,2.6,5" target="0,0.3,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="32"/></film></sensor>
<integrator type="path"><integer name="max_depth" value="8"/></integrator>
<shape type="obj"><string name="filename" value="torus.obj"/>
<bsdf type="roughdielectric"><float name="alpha" value="0.2"/></bsdf></shape>
<shape type="rectangle"><transform name="to_world"><scale value="8"/><rotate x="1" angle="-90"/></transform>
<bsdf type="diffuse"/></shape>
<emitter type="constant"/>"""


def cloudy_sky(rng, width=64):
    """Return a sky with a sun and clouds, (width / 2, width, 3)."""
    envmap = analytic_sky.sunsky(width, 120, 40)
    d = latlong.directions(width // 2, width)
    for axis in rng.normal(size=(CLOUDS, 3)):
        axis = axis / np.linalg.norm(axis)
        envmap = envmap * np.exp(0.6 * np.exp(12 * (d @ axis - 1)))[..., None]
    return envmap.astype(np.float32)


def write_torus(path, around=48, across=24, radius=0.4):
    """Write a torus about the y-axis that stands on y = 0, as OBJ."""
    u = np.repeat(2 * np.pi * np.arange(around) / around, across)
    v = np.tile(2 * np.pi * np.arange(across) / across, around)
    out = 1 + radius * np.cos(v)
    vertices = np.stack([out * np.cos(u), radius * (1 + np.sin(v)), out * np.sin(u)], axis=1)
    corner = np.arange(around * across).reshape(around, across)
    ahead = np.roll(corner, -1, axis=0)
    aside, across = np.roll(corner, -1, axis=1), np.roll(ahead, -1, axis=1)
    faces = np.stack([corner, aside, across, corner, across, ahead], axis=-1).reshape(-1, 3)
    lines = ["v " + " ".join(f"{x:.6f}" for x in vertex) for vertex in vertices]
    lines += ["f " + " ".join(map(str, face + 1)) for face in faces]
    path.write_text("\n".join(lines) + "\n")


def test_a_turn_seen_through_rough_glass_is_found_and_not_spoiled(rng, tmp_path):
    """The target's noise is larger than what most of its pixels say of the turn."""
    write_torus(tmp_path / "torus.obj")
    settings = {
        "scene": {"file": str(write_scene(tmp_path, TORUS, name="torus.xml")), "width": 32},
        "target": {"rotate_degrees": 250, "spp": 64},
        "output": {"spp": 64},
        "representation": {"cycles": 6},
    }
    found = envedit.edit(settings, envmap=cloudy_sky(rng)).metrics
    assert found["turn_degrees"] == pytest.approx(250, abs=2)  # a third of a texel
    assert found["envmap"]["psnr"] > found["initial_envmap"]["psnr"] + 10


@pytest.mark.usefixtures("isolated")
def test_turns_of_one_run_after_another_add_up(rng, tmp_path):
    """Each run edits the map and the scene that the run before has written."""
    images.write_exr(tmp_path / "sky.exr", cloudy_sky(rng, 128))
    settings = {
        "input": {"envmap": str(tmp_path / "sky.exr"), "width": 128},
        "scene": {"file": "sphere", "width": 32},
        "target": {"rotate_degrees": 30, "spp": 64},
        "output": {"spp": 16, "report": False},
        "representation": {"cycles": 6},
    }
    turned = []
    for k in range(2):
        file = tmp_path / f"{k}.toml"
        file.write_text(config.to_toml(config.from_dict(settings)))
        assert runs.call(file, "--out", tmp_path / f"{k}") == 0
        turned.append(runs.measured(tmp_path / f"{k}")["turn_degrees"])
        settings["scene"] = {"file": str(tmp_path / f"{k}" / "edited.xml"), "width": 32}
        settings["input"].pop("envmap", None)
    assert sum(turned) == pytest.approx(60, abs=0.4)  # a seventh of a texel
