"""Scenes as users have them, against plain Mitsuba: the file as it is, rendered by ``mi.load_file``."""

import json
import re

import mitsuba as mi
import numpy as np
import pytest

from envedit import config, inputs, pipeline
from envedit.core import latlong
from envedit.core.errors import ConfigError, InputError
from envedit.images import images
from envedit.scene import scene
from envedit.transport.light_transport import LightTransport
from tests.oracles.builders import BALL, SENSOR, sky, write_scene
from tests.oracles.runs import TINY

pytestmark = pytest.mark.usefixtures("isolated")

PATH = '<integrator type="path"/>'
HIDDEN = '<integrator type="path"><boolean name="hide_emitters" value="true"/></integrator>'
FLOOR = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/>
    <translate y="-1"/></transform></shape>"""
LAMP = """<shape type="disk"><transform name="to_world"><rotate x="1" angle="90"/><scale value="0.4"/>
    <translate x="-1.2" y="0.8"/></transform><emitter type="area"><rgb name="radiance" value="9, 6, 3"/></emitter>
    </shape>"""
TURN = '<transform name="to_world"><rotate x="0.48" y="0.8" z="0.36" angle="70"/></transform>'
PLAIN_SPP, OURS_SPP = 1024, 1024


def light(scale=None, inside="", name="own.exr"):
    given = "" if scale is None else f'<float name="scale" value="{scale}"/>'
    return f'<emitter type="envmap"><string name="filename" value="{name}"/>{given}{inside}</emitter>'


def plain(path, **parameters):
    """Render a file by Mitsuba alone: its own sensor, integrator, map and scale."""
    return np.array(mi.render(mi.load_file(str(path), **parameters), spp=PLAIN_SPP, seed=5))


def close(ours, theirs, noise=0.01):
    """Ratio of means 1, and 4x4 blocks alike, within the noise of two renderings."""
    assert ours.shape == theirs.shape
    height, width = (n // 4 * 4 for n in ours.shape[:2])
    a, b = (
        p[:height, :width].reshape(height // 4, 4, width // 4, 4, -1).mean((1, 3)) for p in (ours, theirs)
    )
    assert ours.mean() / theirs.mean() == pytest.approx(1, abs=noise)
    assert np.abs(a - b).mean() < 2 * noise * b.mean()


# ---- the scene's own map and its scale -----------------------------------------------------------------


@pytest.mark.parametrize(
    "scale, inside, envmap",
    [(None, "", "auto"), (0.5, TURN, "auto"), (3, "", "scene"), (800, TURN, "auto"), (800, "", "other.exr")],
)
def test_the_initial_rendering_is_mitsuba_s_of_the_users_file(scale, inside, envmap, tmp_path, rng):
    """With a lamp beside the map, whose balance with it is the file's, and through T as well."""
    own, other = sky(rng) + 0.1, sky(rng) + 0.1
    images.write_exr(tmp_path / "own.exr", own / (scale or 1))
    images.write_exr(tmp_path / "other.exr", other / (scale or 1))
    path = write_scene(tmp_path, PATH, SENSOR, BALL, FLOOR, LAMP, light(scale, inside))
    used = path
    if envmap == "other.exr":
        used = write_scene(
            tmp_path, PATH, SENSOR, BALL, FLOOR, LAMP, light(scale, inside, envmap), name="b.xml"
        )
    given = {"input": {"envmap": envmap, "width": 16}, "scene": {"file": str(path), "width": 16}}
    settings = config.from_dict(given, tmp_path)
    lit = inputs.load_scene(settings.scene)
    radiance, warnings = inputs.load_map(settings.input, lit)
    expected = plain(used)
    close(lit.render(radiance, OURS_SPP, 3), expected)
    transport = LightTransport.build(lit, 8, 16, spp=128, max_depth="auto")
    transport.resolve(radiance)
    close(transport.apply(mi.TensorXf(radiance)).numpy(), expected, 0.02)
    said = " ".join(inputs.notes(settings.input, lit))
    assert not warnings and (f"scale {scale}" in said) == (scale is not None)
    assert ("not the scene's own" in said) == (envmap == "other.exr")
    assert (f"the scene's own, {tmp_path / 'own.exr'}" in said) == (envmap == "auto")
