"""Changes to a parsed scene, seen through the loaded scene: film, environment, stage and digest."""

import os
import re

import numpy as np
import pytest

from envedit.core.errors import ConfigError, InputError
from envedit.scene import scene
from tests.oracles.builders import BALL, LIGHT, SENSOR, sky, write_scene


@pytest.mark.parametrize("asked, size", [
    ({}, (16, 12)), ({"width": 32}, (32, 24)), ({"height": 6}, (8, 6)), ({"width": 5, "height": 7}, (5, 7)),
])  # fmt: skip
def test_film_size(tmp_path, asked, size):
    loaded = scene.load(write_scene(tmp_path, SENSOR, BALL, LIGHT), **asked)
    assert (loaded.width, loaded.height) == size
    assert loaded.render(np.ones((3, 6, 3)), spp=1).shape == (size[1], size[0], 3)


@pytest.mark.slow
def test_names_of_plugins_in_capitals_are_those_of_mitsuba_3(tmp_path, rng):
    plane = '<shape type="rectangle"><bsdf type="diffuse"/></shape>'
    image = sky(rng)
    expected = scene.load(write_scene(tmp_path, SENSOR, plane, LIGHT)).render(image, spp=4)
    capital = plane.replace("rectangle", "Rectangle").replace("diffuse", "Diffuse")
    light = LIGHT.replace("constant", "Constant")
    loaded = scene.load(write_scene(tmp_path, SENSOR, capital, light, name="capital.xml"))
    np.testing.assert_array_equal(loaded.render(image, spp=4), expected)
    assert np.ptp(expected) > 0.1
    with pytest.raises(InputError, match="oblong"):
        scene.load(write_scene(tmp_path, SENSOR, plane.replace("rectangle", "Oblong"), LIGHT))


@pytest.mark.parametrize("key", ["width", "height"])
@pytest.mark.parametrize("value", ['<integer name="KEY" value="0"/>', '<string name="KEY" value="big"/>'])
def test_a_film_without_a_size_is_refused(tmp_path, key, value):
    number = f'<integer name="{key}" value="{16 if key == "width" else 12}"/>'
    path = write_scene(tmp_path, SENSOR.replace(number, value.replace("KEY", key)), BALL, LIGHT)
    with pytest.raises(InputError, match="the film is .*, expected whole numbers above 0"):
        scene.load(path, width=8)


def test_text_where_a_transform_or_a_number_should_be_is_refused(tmp_path):
    light = '<emitter type="envmap"><string name="to_world" value="up"/></emitter>'
    with pytest.raises(InputError, match="to_world is 'up', expected a <transform>"):
        scene.load(write_scene(tmp_path, SENSOR, BALL, light))
    ball = BALL.replace("<bsdf", '<string name="fit_height" value="tall"/><bsdf', 1)
    with pytest.raises(ConfigError, match="fit_height is tall, expected a positive number"):
        scene.load(write_scene(tmp_path, SENSOR, ball, LIGHT))


@pytest.mark.slow
def test_files_are_looked_for_where_the_scene_says(tmp_path):
    (tmp_path / "assets").mkdir()
    box_obj(tmp_path / "assets" / "box.obj", (1, 1, 1))
    mesh = '<shape type="obj"><string name="filename" value="box.obj"/></shape>'
    with pytest.raises(InputError, match="missing file"):
        scene.load(write_scene(tmp_path, SENSOR, mesh, LIGHT))
    loaded = scene.load(write_scene(tmp_path, '<path value="assets"/>', SENSOR, mesh, LIGHT))
    assert loaded.render(np.ones((3, 6, 3)), spp=1).shape == (12, 16, 3)


def test_the_environment_keeps_its_up_axis(tmp_path):
    matrix = '<transform name="to_world"><rotate x="1" angle="-90"/></transform>'
    upright = scene.load(write_scene(tmp_path, SENSOR, BALL, '<emitter type="sunsky"/>'))
    np.testing.assert_allclose(upright.to_world @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    turned = scene.load(write_scene(tmp_path, SENSOR, BALL, f'<emitter type="sunsky">{matrix}</emitter>'))
    np.testing.assert_allclose(turned.to_world, np.eye(3), atol=1e-7)


def test_the_emitters_key_is_free_of_clashes(tmp_path):
    ball = BALL.replace("<shape", '<shape id="envmap"')
    loaded = scene.load(write_scene(tmp_path, SENSOR, ball, LIGHT))
    assert loaded.envmap_key == "envmap1.data" and loaded.envmap_key in loaded.params


@pytest.mark.slow
def test_zero_roughness_is_the_mirror(rng):
    image = sky(rng)
    smooth = scene.load("sphere", width=16, parameters={"roughness": 0}).render(image, spp=16)
    assert np.array_equal(smooth, scene.load("mirror", width=16).render(image, spp=16))


def box_obj(path, size):
    corners = [[x, y, z] for x in (0, size[0]) for y in (0, size[1]) for z in (0, size[2])]
    faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    path.write_text("\n".join([f"v {x} {y} {z}" for x, y, z in corners] + [f"f {f}" for f in faces]))
    return path


@pytest.mark.parametrize("up, size, expected", [
    ("y", (1, 4, 2), (0.5, 2, 1)), ("z", (1, 2, 4), (0.5, 2, 1)), ("-x", (10, 5, 2.5), (1, 2, 0.5)),
    ("y", (30, 1, 3), (3, 0.1, 0.3)), ("-y", (1, 1, 1), (2, 2, 2)), ("-z", (1, 2, 1e-3), (1.5, 1.5e-3, 3)),
])  # fmt: skip
def test_a_mesh_is_fitted_to_the_stage(tmp_path, up, size, expected):
    path = box_obj(tmp_path / "box.OBJ", size)
    loaded = scene.load("mesh", width=8, parameters={"mesh": path.name, "up": up}, base=tmp_path)
    box = {s.id(): s.bbox() for s in loaded.mi.shapes()}["object"]
    low, high = np.array(box.min).ravel(), np.array(box.max).ravel()
    np.testing.assert_allclose(high - low, expected, rtol=1e-4)
    np.testing.assert_allclose([low[1], *(low + high)[[0, 2]]], 0, atol=1e-5)


def test_the_right_end_is_up(tmp_path):
    # A pyramid's tip is at +z: with up = "z" the mesh's mass lies low, with "-z" it stands on its tip.
    path = tmp_path / "tip.obj"
    points = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nv 0 0 2\n"
    path.write_text(points + "f 1 4 3 2\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n")
    means = []
    for up in ("z", "-z"):
        loaded = scene.load("mesh", width=8, parameters={"mesh": path, "up": up})
        means.append(np.array(loaded.params["object.vertex_positions"]).reshape(-1, 3)[:, 1].mean())
    assert means[0] < 1 < means[1]


def test_a_mesh_that_cannot_stand_is_refused(tmp_path):
    with pytest.raises(InputError, match="no height along its up axis"):
        scene.load("mesh", parameters={"mesh": box_obj(tmp_path / "flat.obj", (1, 0, 1))})
    (tmp_path / "a.stl").write_text("solid")
    with pytest.raises(InputError, match="a.stl: cannot read a mesh of this kind; expected .ply"):
        scene.load("mesh", parameters={"mesh": tmp_path / "a.stl"})
    with pytest.raises(InputError, match="missing file: gone.ply\nlooked in .* and "):
        scene.load("mesh", parameters={"mesh": "gone.ply"}, base=tmp_path)


@pytest.mark.slow
def test_digest_follows_what_the_rendering_depends_on(tmp_path):
    mesh = '<shape type="obj"><string name="filename" value="tent.obj"/></shape>'
    tent = tmp_path / "tent.obj"
    tent.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    digest = scene.load(path := write_scene(tmp_path, SENSOR, mesh, LIGHT)).digest
    assert re.fullmatch("[0-9a-f]{64}", digest) and scene.load(path).digest == digest

    other = tmp_path / "elsewhere"
    other.mkdir()
    (other / "tent.obj").write_bytes(tent.read_bytes())
    map_ = '<emitter type="envmap"><string name="filename" value="any.exr"/></emitter>'
    same = [write_scene(other, SENSOR, mesh, LIGHT), write_scene(other, SENSOR, mesh, map_, name="b.xml")]
    same += [write_scene(other, "<!-- why -->", SENSOR, mesh, LIGHT, name="c.xml")]
    assert {scene.load(p).digest for p in same} == {digest}

    turn = '<transform name="to_world"><rotate y="1" angle="1e-3"/></transform>'
    turned = f'<emitter type="envmap">{turn}</emitter>'
    sensors = [SENSOR.replace('"40"', '"41"'), SENSOR.replace('"box"', '"tent"')]
    digests = [scene.load(write_scene(tmp_path, s, mesh, LIGHT, name="d.xml")).digest for s in sensors]
    digests += [scene.load(write_scene(tmp_path, SENSOR, mesh, turned, name="d.xml")).digest]
    digests += [scene.load(path, width=8).digest]
    digests += [scene.load("sphere", width=16, parameters={"roughness": r}).digest for r in (0.3, 0.31)]
    tent.write_text("v 0 0 0\nv 1 0 0\nv 0 2 0\nf 1 2 3\n")
    digests += [scene.load(path).digest]
    assert len({digest, *digests}) == 1 + len(digests)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="may read everything")
def test_a_file_that_may_not_be_read_is_named(tmp_path):
    path = write_scene(tmp_path, SENSOR, BALL, LIGHT)
    path.chmod(0)
    with pytest.raises(InputError, match=path.name):
        scene.load(path)
