"""USD files that usd-core writes, as scenes: places, directions and quantities as USD defines them."""

import json
import math
import os
import sys

import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("pxr", reason="the extra envedit[usd] is not installed")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, Vt

import envedit
from envedit import config, inputs
from envedit.cli import convert
from envedit.core.errors import ConfigError, EnveditError, InputError
from envedit.images import images
from envedit.scene import scene
from envedit.scene.usd import conversion
from envedit.scene.usd import stage as usd_stage

pytestmark = pytest.mark.usefixtures("own_cache")


# ---- Stages ------------------------------------------------------------------------------------------------


def new_stage(folder, up="Y", unit=1.0, name="shot.usda"):
    stage = Usd.Stage.CreateNew(str(folder / name))
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    return stage


def place(prim, *turns, move=(0, 0, 0), scale=1.0):
    """Turn by angles about axes in turn, as (axis, degrees), then move."""
    matrix = Gf.Matrix4d().SetScale(scale)
    for axis, degrees in turns:
        matrix *= Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(*axis), degrees))
    matrix *= Gf.Matrix4d().SetTranslate(Gf.Vec3d(*move))
    UsdGeom.Xformable(prim).AddTransformOp().Set(matrix)
    return matrix


def add_camera(stage, path="/camera", move=(0, 0, 5), turns=(), focal=50.0, scale=1.0):
    camera = UsdGeom.Camera.Define(stage, path)
    camera.GetHorizontalApertureAttr().Set(40.0)
    camera.GetVerticalApertureAttr().Set(30.0)
    camera.GetFocalLengthAttr().Set(focal)
    place(camera, *turns, move=move, scale=scale)
    return camera


def add_square(stage, path="/square", half=1.0, colour=(1, 1, 1)):
    """A square in the plane of x and y that faces +z."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    corners = [(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)]
    mesh.GetPointsAttr().Set(Vt.Vec3fArray([Gf.Vec3f(*p) for p in corners]))
    mesh.GetFaceVertexCountsAttr().Set([4])
    mesh.GetFaceVertexIndicesAttr().Set([0, 1, 2, 3])
    mesh.GetSubdivisionSchemeAttr().Set("none")
    mesh.GetDisplayColorAttr().Set([Gf.Vec3f(*colour)])
    return mesh


def add_uv(mesh):
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
    )
    primvar.Set(Vt.Vec2fArray([Gf.Vec2f(*p) for p in ((0, 0), (1, 0), (1, 1), (0, 1))]))


def add_material(stage, path, **values):
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    for key, value in values.items():
        kind = Sdf.ValueTypeNames.Color3f if isinstance(value, tuple) else Sdf.ValueTypeNames.Float
        shader.CreateInput(key, kind).Set(Gf.Vec3f(*value) if isinstance(value, tuple) else value)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material, shader


def bind(prim, material):
    UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)


def add_dome(stage, radiance=1.0, path="/dome", file="", kind=UsdLux.DomeLight):
    dome = kind.Define(stage, path)
    dome.CreateIntensityAttr(radiance)
    if file:
        dome.CreateTextureFileAttr(str(file))
    return dome


def add_texture(stage, material, file, reads="st"):
    """A texture of a material's, and what reads its place from a primvar."""
    texture = UsdShade.Shader.Define(stage, f"{material}/texture")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(file)
    reader = UsdShade.Shader.Define(stage, f"{material}/reader")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(reads)
    return texture, reader


def connect(shader, key, source, output, kind=Sdf.ValueTypeNames.Float2):
    shader.CreateInput(key, kind).ConnectToSource(source.ConnectableAPI(), output)


def lit_stage(folder):
    stage = new_stage(folder)
    add_camera(stage)
    add_dome(stage)
    return stage


def saved(stage):
    stage.Save()
    return stage.GetRootLayer().realPath


def loaded(stage, width):
    """Load a stage by its XML, written in this process to spare another one."""
    file = saved(stage)
    xml = f"{file.rpartition('.')[0]}_{len(os.listdir(os.path.dirname(file)))}.xml"
    notes = usd_stage.convert(file, xml)["notes"]
    return scene.load(xml, width), notes


def rendered(stage, width=24, spp=256):
    """Return the picture under the scene's own light, and the scene."""
    found, _ = loaded(stage, width)
    light = inputs.read_map(config.Input(envmap="auto", width=32), found).radiance
    return found.render(light, spp), found


def refusal(stage):
    with pytest.raises(EnveditError) as error:
        loaded(stage, 8)
    assert len(str(error.value).splitlines()) == 1
    return error.value


# ---- Camera ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [(0.0, 0.0), (8.0, -3.0)])
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_a_camera_puts_a_point_where_usd_does(offset, projection, tmp_path):
    stage = new_stage(tmp_path)
    camera = add_camera(stage, move=(1, 2, 9), turns=[((0, 1, 0), 20), ((1, 0, 0), -15)], scale=3.0)
    camera.GetHorizontalApertureOffsetAttr().Set(offset[0])
    camera.GetVerticalApertureOffsetAttr().Set(offset[1])
    camera.GetProjectionAttr().Set(projection)
    add_dome(stage, 0.0)
    stage.GetPrimAtPath("/dome").SetActive(False)
    frustum = UsdGeom.Camera(camera).GetCamera(Usd.TimeCode.Default()).frustum
    if projection == "orthographic":  # Gf's window is in the camera's own units, the scale aside
        place_of = Gf.Matrix4d().SetScale(1 / 3) * UsdGeom.Xformable(camera).GetLocalTransformation()
        frustum.SetPositionAndRotationFromMatrix(place_of)
    target = (0.55, 0.3)  # from the middle, in halves of the picture
    ray = frustum.ComputePickRay(Gf.Vec2d(*target))
    point = ray.GetPoint(6.0) if projection == "orthographic" else ray.startPoint + ray.direction * 6.0
    ball = UsdGeom.Sphere.Define(stage, "/ball")
    ball.GetRadiusAttr().Set(0.05 if projection == "perspective" else 0.03)
    place(ball, move=point)
    light = UsdLux.DistantLight.Define(stage, "/light")
    place(light, ((0, 1, 0), 20), ((1, 0, 0), -15))
    found, notes = loaded(stage, 160)
    picture = found.render(np.zeros((4, 8, 3)), 64)[..., 0]
    rows, columns = np.nonzero(picture > 0.2 * picture.max())
    weight = picture[rows, columns]
    x = (np.average(columns, weights=weight) + 0.5) / 160 * 2 - 1
    y = 1 - (np.average(rows, weights=weight) + 0.5) / 120 * 2
    assert picture.max() > 0 and abs(x - target[0]) < 0.015 and abs(y - target[1]) < 0.02


@pytest.mark.slow
def test_cameras_are_named_where_there_are_several(tmp_path, capsys):
    stage = new_stage(tmp_path)
    add_square(stage)
    add_dome(stage)
    assert "no camera" in str(refusal(stage))
    add_camera(stage, "/one")
    add_camera(stage, "/two", focal=100.0)
    with pytest.raises(ConfigError, match=r"2 cameras \(/one, /two\): choose one, such as --camera /one"):
        scene.load(saved(stage), 8)
    assert scene.load(saved(stage), 8, sensors=("/two",)).views[0].name == "/two"
    assert len(scene.load(saved(stage), 8, sensors="all").views) == 2
    assert convert.main([saved(stage), str(tmp_path / "a.xml")]) == 2
    assert "choose one" in capsys.readouterr().err
    assert convert.main([saved(stage), str(tmp_path / "a.xml"), "--camera", "/two"]) == 0
    assert len(scene.load(tmp_path / "a.xml", 8).mi.sensors()) == 1


# ---- Light -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_a_white_dome_lights_a_white_plane_with_its_radiance(unit, tmp_path):
    stage = new_stage(tmp_path, unit=unit)
    add_square(stage, half=100 / unit)
    add_camera(stage, move=(0, 0, 5 / unit))
    dome = add_dome(stage, 0.25)
    dome.CreateExposureAttr(2.0)
    picture, _ = rendered(stage, 8)
    assert np.allclose(picture, 1.0, atol=0.02)


@pytest.mark.parametrize("kind", [UsdLux.DomeLight, UsdLux.DomeLight_1])
@pytest.mark.parametrize("up", ["Y", "Z"])
def test_a_texel_of_a_dome_lights_from_where_usd_says(kind, up, tmp_path):
    """OpenEXR: the left edge is longitude +pi, which is -z; longitude pi/2 is +x; up is +y."""
    image = np.full((32, 64, 3), 0.01, np.float32)
    row, column = 10, 13
    image[row, column] = 5000
    images.write_exr(tmp_path / "sky.exr", image)
    stage = new_stage(tmp_path, up)
    add_camera(stage)
    dome = add_dome(stage, 2.0, file=tmp_path / "sky.exr", kind=kind)
    matrix = place(dome, ((1, 0, 0), 30), ((0, 0, 1), 70))
    add_square(stage)
    found, notes = loaded(stage, 8)

    # ---- By the definition
    longitude = math.pi - (column + 0.5) / 64 * 2 * math.pi
    latitude = math.pi / 2 - row / 31 * math.pi  # rows as Mitsuba has them (docs/pipelines.md)
    flat = math.cos(latitude)
    x, y, z = flat * math.sin(longitude), math.sin(latitude), flat * math.cos(longitude)
    local = (x, -z, y) if kind is UsdLux.DomeLight_1 and up == "Z" else (x, y, z)
    direction = np.array(matrix.TransformDir(Gf.Vec3d(*local)))

    # ---- By the scene
    emitter = found.mi.environment()
    light = inputs.read_map(config.Input(envmap="auto"), found)
    found.set_envmap(light.radiance)
    si = mi.SurfaceInteraction3f()
    si.wi = -mi.Vector3f(*map(float, direction))
    assert np.isclose(np.array(emitter.eval(si)).ravel()[0], 10000, rtol=0.02)


def test_colour_of_a_dome_is_multiplied_into_its_map(tmp_path):
    image = np.random.default_rng(0).random((8, 16, 3), np.float32)
    images.write_exr(tmp_path / "sky.exr", image)
    stage = new_stage(tmp_path)
    add_camera(stage)
    add_square(stage)
    dome = add_dome(stage, 2.0, file="./sky.exr")
    dome.CreateColorAttr(Gf.Vec3f(1, 0.5, 0.25))
    found, notes = loaded(stage, 8)
    light = inputs.read_map(config.Input(envmap="auto"), found)
    assert np.allclose(light.radiance, image * [2, 1, 0.5], rtol=1e-5)
    assert any("colour of a dome light" in note for note in notes)


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("angle", [0.0, 0.53, 4.0])
def test_irradiance_of_a_distant_light(normalize, angle, tmp_path):
    stage = new_stage(tmp_path)
    add_square(stage, half=50)
    add_camera(stage, turns=[])
    light = UsdLux.DistantLight.Define(stage, "/sun")
    light.CreateIntensityAttr(3.0)
    light.CreateColorAttr(Gf.Vec3f(1, 0.5, 0))
    light.CreateAngleAttr(angle)
    light.CreateNormalizeAttr(normalize)
    place(light, ((0, 1, 0), 60))
    found, notes = loaded(stage, 8)
    size = math.pi * math.sin(math.radians(angle) / 2) ** 2 or 1.0
    irradiance = (3.0 if normalize else 3.0 * size) * math.cos(math.radians(60))
    picture = found.render(np.zeros((4, 8, 3)), 1024).mean(axis=(0, 1))
    assert np.allclose(picture, np.multiply([1, 0.5, 0], irradiance / math.pi), rtol=0.02, atol=1e-9)


@pytest.mark.parametrize(("scale", "kind"), [(0.5, "sphere"), (Gf.Vec3d(1, 0.4, 0.7), "ply")])
def test_a_stretched_sphere_is_no_longer_round(scale, kind, tmp_path):
    """The extent of what is seen, and normals that point outwards, as the picture under white light says."""
    stage = new_stage(tmp_path)
    add_camera(stage, move=(0, 0, 8))
    ball = UsdGeom.Sphere.Define(stage, "/ball")
    ball.GetRadiusAttr().Set(2.0)
    place(ball, scale=scale)
    found, _ = loaded(stage, 64)
    (shape,) = found.mi.shapes()
    box = shape.bbox()
    expected = 2.0 * np.broadcast_to(np.array(scale, float), 3)
    np.testing.assert_allclose([box.max.x, box.max.y, box.max.z], expected, rtol=0.002)
    assert shape.is_mesh() == (kind == "ply")
    picture = found.render(np.ones((4, 8, 3)), 64)[..., 0]
    surface = picture[np.hypot(*(np.indices(picture.shape) - np.array(picture.shape)[:, None, None] / 2)) < 4]
    np.testing.assert_allclose(surface, surface.mean(), rtol=0.1)


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("kind", ["RectLight", "DiskLight", "SphereLight", "point", "spot"])
def test_light_of_a_lamp_far_away(kind, normalize, tmp_path):
    """The irradiance on the axis is radiance times the area as it is seen, over the squared distance."""
    stage = new_stage(tmp_path)
    add_square(stage, half=0.2)
    add_camera(stage, move=(0.3, 0, 2), turns=[((0, 1, 0), 8.5)], focal=400.0)
    lamp = getattr(UsdLux, kind if kind.endswith("Light") else "SphereLight").Define(stage, "/lamp")
    lamp.CreateIntensityAttr(100.0)
    lamp.CreateNormalizeAttr(normalize)
    place(lamp, move=(0, 0, 30), scale=2.0)
    round_area = math.pi * (2 * 0.2) ** 2
    seen, whole = round_area, round_area
    if kind == "RectLight":
        lamp.CreateWidthAttr(0.4)
        lamp.CreateHeightAttr(0.2)
        seen = whole = 0.8 * 0.4
    else:
        lamp.CreateRadiusAttr(0.2)
        whole = round_area if kind == "DiskLight" else 4 * round_area
    if kind == "point":
        lamp.CreateTreatAsPointAttr(True)
    if kind == "spot":
        UsdLux.ShapingAPI.Apply(lamp.GetPrim()).CreateShapingConeAngleAttr(30.0)
    found, notes = loaded(stage, 8)
    picture = found.render(np.zeros((4, 8, 3)), 1024)
    radiance = 100.0 / whole if normalize else 100.0
    assert np.allclose(picture.mean(), radiance * seen / 30**2 / math.pi, rtol=0.02)


# ---- Meshes ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_instances_stand_where_copies_would(tmp_path):
    pictures = []
    places = [(-0.9, -0.5, 0), (0.8, 0.4, 0.5)]
    for kind in ("copies", "instanceable", "points"):
        folder = tmp_path / kind
        folder.mkdir()
        stage = lit_stage(folder)
        if kind == "copies":
            for k, move in enumerate(places):
                place(add_square(stage, f"/s{k}", 0.4, (0.8, 0.4, 0.1)), move=move)
        elif kind == "instanceable":
            stage.CreateClassPrim("/proto")
            add_square(stage, "/proto/square", 0.4, (0.8, 0.4, 0.1))
            for k, move in enumerate(places):
                one = UsdGeom.Xform.Define(stage, f"/i{k}")
                one.GetPrim().GetReferences().AddInternalReference("/proto")
                one.GetPrim().SetInstanceable(True)
                place(one, move=move)
        else:
            cloud = UsdGeom.PointInstancer.Define(stage, "/cloud")
            add_square(stage, "/cloud/square", 0.4, (0.8, 0.4, 0.1))
            cloud.CreatePrototypesRel().AddTarget("/cloud/square")
            cloud.CreateProtoIndicesAttr([0, 0, 0])
            cloud.CreatePositionsAttr([Gf.Vec3f(*p) for p in (*places, (0, 0, 0))])
            cloud.InvisId(2, Usd.TimeCode.Default())
        picture, found = rendered(stage, 32, 64)
        pictures.append(picture)
        assert len(found.mi.shapes()) == 2
    assert np.ptp(pictures, axis=0).max() < 0.02
    assert pictures[0].std() > 0.1


@pytest.mark.slow
def test_subsets_have_their_materials_and_rows_of_textures_go_up(tmp_path):
    """The lower half of the square is red; the upper has a texture whose first row is white, others black."""
    stage = lit_stage(tmp_path)
    mesh = UsdGeom.Mesh.Define(stage, "/mesh")
    points = [(x, y, 0) for y in (-1, 0, 1) for x in (-1, 1)]
    mesh.GetPointsAttr().Set(Vt.Vec3fArray([Gf.Vec3f(*p) for p in points]))
    mesh.GetFaceVertexCountsAttr().Set([4, 4])
    mesh.GetFaceVertexIndicesAttr().Set([0, 1, 3, 2, 2, 3, 5, 4])
    mesh.GetSubdivisionSchemeAttr().Set("none")
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("map", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
    st.Set(Vt.Vec2fArray([Gf.Vec2f((x + 1) / 2, y) for x, y, _ in points]))
    red, _ = add_material(stage, "/red", diffuseColor=(1.0, 0.0, 0.0), ior=1.0)
    textured, shader = add_material(stage, "/textured", ior=1.0)
    pixels = np.zeros((2, 2, 3), np.uint8)
    pixels[0] = 255
    mi.Bitmap(pixels).write(str(tmp_path / "rows.png"))
    texture, reader = add_texture(stage, "/textured", "rows.png", reads="map")
    connect(texture, "st", reader, "result")
    connect(shader, "diffuseColor", texture, "rgb", Sdf.ValueTypeNames.Color3f)
    bind(mesh, textured)
    subset = UsdShade.MaterialBindingAPI(mesh).CreateMaterialBindSubset("lower", Vt.IntArray([0]))
    bind(subset, red)
    picture, found = rendered(stage, 32, 64)
    assert len(found.mi.shapes()) == 2
    assert np.allclose(picture[16, 16], [1, 0, 0], atol=0.05)
    assert np.allclose(picture[5, 16], 1, atol=0.05) and np.allclose(picture[10, 16], 0, atol=0.05)


def test_what_is_hidden_or_a_guide_is_left_out(tmp_path):
    stage = lit_stage(tmp_path)
    add_square(stage, "/shown")
    add_square(stage, "/hidden").MakeInvisible()
    UsdGeom.Imageable(add_square(stage, "/guide")).GetPurposeAttr().Set("guide")
    UsdGeom.Imageable(add_square(stage, "/proxy")).GetPurposeAttr().Set("proxy")
    UsdGeom.Imageable(add_square(stage, "/render")).GetPurposeAttr().Set("render")
    UsdGeom.BasisCurves.Define(stage, "/hair")
    UsdGeom.Mesh.Define(stage, "/empty")
    late = add_square(stage, "/late")
    late.GetVisibilityAttr().Set("invisible", 10)
    late.GetVisibilityAttr().Set("inherited", 20)
    stage.SetStartTimeCode(10)
    stage.SetEndTimeCode(20)
    found, notes = loaded(stage, 8)
    assert len(found.mi.shapes()) == 2
    assert [note for note in notes if "BasisCurves (/hair)" in note]
    made = conversion.convert(saved(stage), tmp_path / "late.xml", time=20.0)
    assert len(scene.load(made.xml, 8).mi.shapes()) == 3


@pytest.mark.slow
def test_one_channel_of_a_texture_that_is_moved_scaled_and_turned(tmp_path):
    """Alpha is 0, 0.25, 0.5, 0.75 in four columns; a texture turned by 90 degrees runs along y instead."""
    stage = lit_stage(tmp_path)
    mesh = add_square(stage)
    add_uv(mesh)
    material, shader = add_material(stage, "/cut", diffuseColor=(0.0, 0.0, 0.0), ior=1.0)
    pixels = np.full((4, 4, 4), 255, np.uint8)
    pixels[..., 3] = [0, 64, 128, 192]
    mi.Bitmap(pixels).write(str(tmp_path / "a.png"))
    texture, reader = add_texture(stage, "/cut", "a.png")
    texture.CreateInput("wrapS", Sdf.ValueTypeNames.Token).Set("repeat")
    move = UsdShade.Shader.Define(stage, "/cut/move")
    move.CreateIdAttr("UsdTransform2d")
    move.CreateInput("rotation", Sdf.ValueTypeNames.Float).Set(-90.0)  # (u, v) -> (v, -u)
    move.CreateInput("scale", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(1, 0.5))
    move.CreateInput("translation", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(0.25, 1))
    connect(move, "in", reader, "result")
    connect(texture, "st", move, "result")
    connect(shader, "opacity", texture, "a", Sdf.ValueTypeNames.Float)
    bind(mesh, material)
    picture, _ = rendered(stage, 48, 256)
    for v in (0.125, 0.375):  # middles of texels: u = v / 2 + 0.25
        row = int((1 - (2 * v - 1) / 1.5) * 18)
        column = (0.5 * (1 - (row + 0.5) / 18) * 1.5 + 0.5) / 2 + 0.25
        alpha = np.interp(column, np.array([0.5, 1.5, 2.5, 3.5]) / 4, np.array([0, 64, 128, 192]) / 255)
        assert np.allclose(picture[row, 24], 1 - alpha, atol=0.04)


@pytest.mark.slow
def test_glass_gold_and_a_cut_out(tmp_path):
    stage = lit_stage(tmp_path)
    gold, _ = add_material(stage, "/gold", diffuseColor=(1.0, 0.7, 0.3), metallic=1.0, roughness=0.2)
    half, _ = add_material(stage, "/half", diffuseColor=(0.0, 0.0, 0.0), opacity=0.25, ior=1.0)
    glass = UsdShade.Material.Define(stage, "/glass")
    shader = UsdShade.Shader.Define(stage, "/glass/surface")
    shader.CreateIdAttr("ND_open_pbr_surface_surfaceshader")
    shader.CreateInput("transmission_weight", Sdf.ValueTypeNames.Float).Set(1.0)
    shader.CreateInput("base_color", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(1, 1, 1))
    glass.CreateSurfaceOutput("mtlx").ConnectToSource(shader.ConnectableAPI(), "surface")
    for k, material in enumerate((gold, half, glass)):
        square = material is not glass
        shape = add_square(stage, f"/s{k}", 0.5) if square else UsdGeom.Sphere.Define(stage, "/ball")
        place(shape, move=(1.2 * (k - 1), 0, 0), scale=1.0 if square else 0.5)
        bind(shape, material)
    picture, _ = rendered(stage, 48, 256)
    row = picture[18]
    assert np.allclose(row[10], [1, 0.7, 0.3], atol=0.08)
    assert np.allclose(row[24], 0.75, atol=0.05)
    assert np.allclose(row[38], 1, atol=0.1)


# ---- Errors ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_what_is_missing_or_damaged_is_named(tmp_path):
    stage = new_stage(tmp_path)
    add_camera(stage)
    dome = add_dome(stage, file="none.exr")
    assert "no surface to light" in str(refusal(stage))
    add_square(stage)
    error = refusal(stage)
    assert isinstance(error, InputError) and "/dome: texture none.exr: the file is missing" in str(error)
    dome.GetTextureFileAttr().Clear()
    add_dome(stage, path="/second")
    assert "/second: a second dome light" in str(refusal(stage))
    stage.GetPrimAtPath("/second").SetActive(False)
    dome.AddScaleOp().Set(Gf.Vec3f(1, 2, 1))
    assert "stretches" in str(refusal(stage))
    stage.GetPrimAtPath("/dome").SetActive(False)
    found = scene.load(saved(stage), 8)
    with pytest.raises(InputError, match="no environment emitter: add a DomeLight, or give a map"):
        inputs.read_map(config.Input(envmap="auto"), found)
    UsdGeom.Mesh.Get(stage, "/square").GetFaceVertexIndicesAttr().Set([0, 1, 2, 9])
    assert "do not fit together" in str(refusal(stage))
    (tmp_path / "text.usda").write_text("no USD")
    with pytest.raises(InputError, match=r"cannot be read as USD \(.*not a valid usda layer\)"):
        scene.load(tmp_path / "text.usda", 8)
    (tmp_path / "typo.usda").write_text('#usda 1.0\ndef Sphere "ball"\n{\n    double radius 1\n}\n')
    with pytest.raises(InputError, match=r"cannot be read as USD \(.*typo\.usda:4:"):
        scene.load(tmp_path / "typo.usda", 8)
    with pytest.raises(InputError, match="no such file"):
        scene.load(tmp_path / "none.usda", 8)


def multiplied(levels, options):
    """Return a stage in which each class refers ten times to the one before."""
    lines = ["#usda 1.0", 'def Camera "c" {', "}", 'class "p0" {', 'def Sphere "s" {', "}", "}"]
    for k in range(1, levels + 1):
        lines.append(f'class "p{k}" {{')
        for j in range(10):
            lines += [f'def "i{j}" ({options}prepend references = </p{k - 1}>) {{', "}"]
        lines.append("}")
    return "\n".join([*lines, f'def "world" (prepend references = </p{levels}>) {{', "}", ""])


def test_a_cloud_of_too_many_instances(tmp_path):
    stage = lit_stage(tmp_path)
    cloud = UsdGeom.PointInstancer.Define(stage, "/cloud")
    add_square(stage, "/cloud/square")
    cloud.CreatePrototypesRel().AddTarget("/cloud/square")
    cloud.CreateProtoIndicesAttr(Vt.IntArray(100_000))
    cloud.CreatePositionsAttr(Vt.Vec3fArray(100_000))
    assert "/cloud declares 100000 instances" in str(refusal(stage))


@pytest.mark.slow
def test_references_that_multiply(tmp_path):
    (tmp_path / "bomb.usda").write_text(multiplied(11, "instanceable = true\n"))
    with pytest.raises(InputError, match="declares more"):
        scene.load(tmp_path / "bomb.usda", 8)


# ---- Files -------------------------------------------------------------------------------------------------


def test_a_load_looks_for_the_converted_scene_once(tmp_path, monkeypatch):
    stage = new_stage(tmp_path)
    add_camera(stage)
    add_square(stage)
    asked = []
    kept = conversion.kept
    monkeypatch.setattr(conversion, "kept", lambda file: asked.append(file) or kept(file))
    notes = scene.load(saved(stage), 8).notes
    assert len(asked) == 1 and "shot.usda: no light in the stage: give a map (/)" in notes
    (tmp_path / "file").touch()  # where no cache can be kept, the scene is made for this process
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert scene.load(saved(stage), 8).notes == notes


@pytest.mark.slow
def test_a_scene_is_made_anew_when_a_layer_changes(tmp_path):
    below = new_stage(tmp_path, name="below.usda")
    add_square(below)
    saved(below)
    stage = new_stage(tmp_path)
    stage.GetRootLayer().subLayerPaths.append("below.usda")
    add_camera(stage)
    add_dome(stage)
    first = scene.load(saved(stage), 8)
    assert scene.load(saved(stage), 8).digest == first.digest
    assert str(tmp_path / "below.usda") in map(str, scene.files(config.Scene(str(first.path))))
    UsdGeom.Mesh.Get(below, "/square").GetDisplayColorAttr().Set([Gf.Vec3f(0.5, 0.5, 0.5)])
    saved(below)
    assert scene.load(saved(stage), 8).digest != first.digest

    # ---- Also where what is copied of a texture changes
    images.write_exr(tmp_path / "sky.exr", np.full((8, 16, 3), 0.5, np.float32))
    dome = UsdLux.DomeLight.Get(stage, "/dome")
    dome.CreateTextureFileAttr("sky.exr")
    dome.CreateColorAttr(Gf.Vec3f(1, 0.5, 0.25))
    before = scene.load(saved(stage), 8).own.file
    images.write_exr(tmp_path / "sky.exr", np.full((8, 16, 3), 0.25, np.float32))
    after = scene.load(saved(stage), 8).own.file
    assert before == after and np.allclose(images.load_envmap(after)[0], [0.25, 0.125, 0.0625])


def test_convert_overwrites_nothing_and_reports_in_json(tmp_path, capsys):
    stage = new_stage(tmp_path)
    add_camera(stage).GetFStopAttr().Set(2.8)
    add_dome(stage)
    add_square(stage)
    target = tmp_path / "made.xml"
    assert convert.main([saved(stage), str(target), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["ok"] and facts["files"] == {"made.xml": str(target)}
    assert facts["warnings"] == ["shot.usda: not read: depth of field (/camera)"]
    before = target.read_bytes()
    assert convert.main([saved(stage), str(target)]) == 3
    assert "exists already" in capsys.readouterr().err and target.read_bytes() == before
    assert convert.main([str(target), str(tmp_path / "b.xml")]) == 2
    assert sorted(one.name for one in tmp_path.iterdir() if one.name.startswith(".")) == []


@pytest.mark.slow
def test_a_package_has_its_textures_in_it(tmp_path):
    from pxr import UsdUtils

    images.write_exr(tmp_path / "sky.exr", np.full((8, 16, 3), 0.5, np.float32))
    stage = new_stage(tmp_path)
    add_camera(stage)
    add_square(stage)
    add_dome(stage, 3.0, file="sky.exr")
    packed = tmp_path / "shot.usdz"
    assert UsdUtils.CreateNewUsdzPackage(saved(stage), str(packed))
    (tmp_path / "sky.exr").unlink()
    (tmp_path / "shot.usda").unlink()
    found = scene.load(packed, 8)
    assert np.allclose(inputs.read_map(config.Input(envmap="auto"), found).radiance, 1.5)


def test_the_extra_is_named_where_it_is_not_installed(tmp_path, monkeypatch, capsys):
    (tmp_path / "shot.usda").write_text("#usda 1.0")
    monkeypatch.setitem(sys.modules, "pxr", None)
    assert convert.main([str(tmp_path / "shot.usda"), str(tmp_path / "a.xml")]) == 4
    assert "pip install '.[usd]'" in capsys.readouterr().err


@pytest.mark.slow
def test_what_a_run_leaves_changes_nothing_of_the_file_but_its_sky(tmp_path, rng):
    """The stage above the user's file is a scene again, and is rendered as the run rendered its result."""
    images.write_exr(tmp_path / "sky.exr", rng.random((8, 16, 3), np.float32) + 0.1)
    stage = new_stage(tmp_path, up="Z", unit=0.01)
    add_camera(stage, "/World/camera")
    add_square(stage, "/World/square")
    dome = add_dome(stage, 2.0, "/World/lights/sky", "sky.exr")
    place(dome, ((1, 0, 0), 90), ((0, 0, 1), 40))
    stage.GetRootLayer().Save()
    before = (tmp_path / "shot.usda").read_bytes()
    tables = {
        "input": {"width": 16},
        "scene": {"file": str(tmp_path / "shot.usda"), "width": 16},
        "target": {"kind": "none"},
        "output": {"exposure": 1.0, "spp": 256},
    }
    result = envedit.edit(config.from_dict(tables, tmp_path))
    result.save(tmp_path / "run")
    assert (tmp_path / "shot.usda").read_bytes() == before
    edited = Usd.Stage.Open(str(tmp_path / "run" / "edited.usda"))
    assert UsdGeom.GetStageUpAxis(edited) == "Z" and UsdGeom.GetStageMetersPerUnit(edited) == 0.01
    assert not edited.GetPrimAtPath("/World/lights/sky").IsActive()
    assert edited.GetPrimAtPath("/World/square").IsA(UsdGeom.Mesh)
    again = scene.load(tmp_path / "run" / "edited.usda", 16)
    envmap, _ = inputs.load_map(config.Input(envmap="scene", width=16), again)
    rendered = again.render(envmap, 256, 3)
    np.testing.assert_allclose(rendered.mean(), result.render.mean(), rtol=0.02)
    np.testing.assert_allclose(envmap, 2 * result.input_map.radiance, rtol=1e-5)
