"""Blender's scenes by its USD exporter, beside Cycles: directions and strengths of every kind of light.

Blender is PyPI's ``bpy``, in an interpreter that ``ENVEDIT_BPY`` names.
"""

import json

import numpy as np
import pytest

import envedit
from envedit import config, inputs
from envedit.core import latlong
from envedit.core.color import tonemap
from envedit.images import images
from envedit.scene import scene
from tests.oracles import blender

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_cache")]

SCENES = ("dome", "AREA", "SUN", "POINT", "SPOT")
SIZE = 64, 48
SCRIPT = """
import json, math, sys
import bpy
from mathutils import Vector

folder, names = json.load(sys.stdin)


def aim(thing, target):
    turn = Vector(target) - thing.location
    thing.rotation_euler = turn.to_track_quat("-Z", "Y").to_euler()


for name in names:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    grey = bpy.data.materials.new("grey")
    grey.use_nodes = True
    surface = grey.node_tree.nodes["Principled BSDF"]
    surface.inputs["Base Color"].default_value = (0.5, 0.5, 0.5, 1)
    surface.inputs["Specular IOR Level"].default_value = 0
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32)
    bpy.ops.object.shade_smooth()
    bpy.context.object.data.materials.append(grey)
    bpy.ops.object.camera_add(location=(1, -4, 1.5))
    scene.camera = bpy.context.object
    aim(scene.camera, (0, 0, 0))
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    background = nodes["Background"]
    background.inputs["Color"].default_value = (0, 0, 0, 1)
    if name == "dome":
        picture = nodes.new("ShaderNodeTexEnvironment")
        picture.image = bpy.data.images.load(folder + "/sky.exr")
        place = nodes.new("ShaderNodeTexCoord")
        turn = nodes.new("ShaderNodeMapping")
        turn.inputs["Rotation"].default_value = (0, 0, math.radians(40))
        factor = nodes.new("ShaderNodeVectorMath")
        factor.operation = "MULTIPLY"
        factor.inputs[1].default_value = (1.5, 1.5, 1.5)
        links.new(place.outputs["Generated"], turn.inputs["Vector"])
        links.new(turn.outputs["Vector"], picture.inputs["Vector"])
        links.new(picture.outputs["Color"], factor.inputs[0])
        links.new(factor.outputs[0], background.inputs["Color"])
    else:
        bpy.ops.object.light_add(type=name, location=(1.5, -3, 2.5))
        lamp = bpy.context.object
        lamp.data.energy = 3 if name == "SUN" else 100
        if name == "AREA":
            lamp.data.size = 0.5
        if name == "SPOT":
            lamp.data.spot_blend = 0
            lamp.data.spot_size = math.radians(60)
        aim(lamp, (0, 0, 0))
    use_cycles(scene, SIZE)
    scene.render.filepath = f"{folder}/{name}.exr"
    bpy.ops.wm.usd_export(filepath=f"{folder}/{name}.usdc", generate_materialx_network=True)
    bpy.ops.render.render(write_still=True)
"""


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Return a folder with a USD file and Cycles' picture of every scene."""
    pytest.importorskip("pxr", reason="the extra envedit[usd] is not installed")
    folder = tmp_path_factory.mktemp("blender")
    sky = np.full((128, 256, 3), 0.1, np.float32)
    sky[40, 100] = 8000
    images.write_exr(folder / "sky.exr", sky)
    blender.run(SCRIPT.replace("SIZE", str(SIZE)), json.dumps([str(folder), SCENES]))
    return folder


@pytest.mark.parametrize("name", SCENES)
def test_light_has_the_direction_and_strength_that_cycles_gives_it(name, exported):
    found = scene.load(exported / f"{name}.usdc", SIZE[0])
    settings = config.Input(envmap="auto", width=256)
    black = np.zeros((4, 8, 3), np.float32)
    ours = found.render(inputs.read_map(settings, found).radiance if name == "dome" else black, 256)
    angle, stops = blender.difference(found, SIZE, ours, blender.read(exported / f"{name}.exr"))
    print(f"{name}: {angle:.2f} degrees, {stops:+.3f} stops")
    # Blender 5.0.1 writes a quarter of the strength of a sun.
    assert angle < 1 and abs(stops - (-2 if name == "SUN" else 0)) < 0.1


# ---- Whole scenes ------------------------------------------------------------------------------------------

WHOLE = ("glass", "character", "room")
WHOLE_SIZE = 96, 72
WHOLE_SCRIPT = """
import json, math, sys
import bpy
from mathutils import Vector

folder, names = json.load(sys.stdin)


def material(name, **inputs):
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    surface = made.node_tree.nodes["Principled BSDF"]
    surface.inputs["Specular IOR Level"].default_value = 0
    for key, value in inputs.items():
        surface.inputs[key.replace("_", " ")].default_value = value
    return made


def add(kind, of=None, parent=None, **where):
    getattr(bpy.ops.mesh, f"primitive_{kind}_add")(**where)
    made = bpy.context.object
    if kind == "uv_sphere":
        bpy.ops.object.shade_smooth()
    if of is not None:
        made.data.materials.append(of)
    if parent is not None:
        made.parent = parent
    return made


for name in names:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    picture = nodes.new("ShaderNodeTexEnvironment")
    picture.image = bpy.data.images.load(folder + "/sky.exr")
    place, turn = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
    links.new(place.outputs["Generated"], turn.inputs["Vector"])
    links.new(turn.outputs["Vector"], picture.inputs["Vector"])
    links.new(picture.outputs["Color"], nodes["Background"].inputs["Color"])
    eye, target = (1, -7, 2.5), (0, 0, 0.8)
    if name == "glass":
        floor = material("floor")
        texture = floor.node_tree.nodes.new("ShaderNodeTexImage")
        texture.image = bpy.data.images.load(folder + "/floor.png")
        base = floor.node_tree.nodes["Principled BSDF"].inputs["Base Color"]
        floor.node_tree.links.new(texture.outputs["Color"], base)
        add("plane", floor, size=12)
        glass = material("glass", Transmission_Weight=1.0, Roughness=0.0, IOR=1.45)
        glass.node_tree.nodes["Principled BSDF"].inputs["Specular IOR Level"].default_value = 0.5
        add("uv_sphere", glass, location=(-1.2, 0, 1), segments=64, ring_count=32)
        gold = material("gold", Metallic=1.0, Roughness=0.3, Base_Color=(0.9, 0.6, 0.2, 1))
        add("uv_sphere", gold, location=(1.2, 0, 1), segments=64, ring_count=32)
    elif name == "character":
        skin = material("skin", Base_Color=(0.6, 0.4, 0.3, 1))
        add("plane", material("ground", Base_Color=(0.4, 0.4, 0.4, 1)), size=12)
        hips = bpy.data.objects.new("hips", None)
        scene.collection.objects.link(hips)
        hips.location, hips.rotation_euler = (0, 0, 1), (0, 0, math.radians(20))
        body = add("uv_sphere", skin, hips, segments=640, ring_count=320)
        body.scale = (0.7, 0.5, 1.0)
        head = add("uv_sphere", skin, body, location=(0, 0, 1.4), segments=64, ring_count=32)
        head.scale = (0.55, 0.7, 0.4)
        for side in (-1, 1):
            arm = add("cylinder", skin, body, location=(1.2 * side, 0, 0.3), radius=0.2, depth=1.4)
            arm.rotation_euler = (0, math.radians(50 * side), 0)
        eye, target = (1, -7, 2.5), (0, 0, 1.4)
    else:
        wall = material("wall", Base_Color=(0.7, 0.7, 0.65, 1))
        half = math.radians(90)
        add("plane", wall, size=4)
        add("plane", wall, size=4, location=(0, 0, 4), rotation=(2 * half, 0, 0))
        add("plane", wall, size=4, location=(0, 2, 2), rotation=(half, 0, 0))
        add("plane", wall, size=4, location=(-2, 0, 2), rotation=(0, half, 0))
        for z, size in ((0.5, 1.0), (3.5, 1.0)):  # above and below the window
            strip = add("plane", wall, size=1, location=(2, 0, z), rotation=(0, -half, 0))
            strip.scale = (size, 4, 1)
        add("cube", material("box", Base_Color=(0.3, 0.4, 0.7, 1)), size=1.2, location=(-0.5, 0.6, 0.6))
        bpy.ops.object.light_add(type="AREA", location=(0, 0, 3.9))
        bpy.context.object.data.energy, bpy.context.object.data.size = 40, 1
        eye, target = (0, -7.5, 2), (0, 0, 2)
    bpy.ops.object.camera_add(location=eye)
    scene.camera = bpy.context.object
    scene.camera.rotation_euler = (Vector(target) - Vector(eye)).to_track_quat("-Z", "Y").to_euler()
    use_cycles(scene, SIZE)
    scene.cycles.blur_glossy = 0
    scene.cycles.max_bounces = scene.cycles.diffuse_bounces = 64
    scene.render.filepath = f"{folder}/{name}.exr"
    bpy.ops.wm.usd_export(filepath=f"{folder}/{name}.usdc", generate_materialx_network=True)
    bpy.ops.render.render(write_still=True)
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return a folder with USD files and Cycles' pictures of three scenes under a sky with a soft light."""
    pytest.importorskip("pxr", reason="the extra envedit[usd] is not installed")
    folder = tmp_path_factory.mktemp("whole")
    toward = latlong.directions(64, 128)
    sky = 0.3 + 0.5 * np.maximum(toward[..., 1:2], 0) * np.array([0.6, 0.8, 1.2])
    sun = latlong.directions(64, 128)[20, 30]
    sky = sky + 20 * np.exp(30 * (toward @ sun - 1))[..., None] * np.array([1.0, 0.9, 0.7])
    images.write_exr(folder / "sky.exr", sky)
    tiles = (np.indices((64, 64)) // 8).sum(axis=0) % 2
    images.write_png(folder / "floor.png", np.where(tiles[..., None] > 0, [0.7, 0.7, 0.7], [0.2, 0.3, 0.4]))
    blender.run(WHOLE_SCRIPT.replace("SIZE", str(WHOLE_SIZE)), json.dumps([str(folder), WHOLE]))
    return folder


@pytest.mark.parametrize("name", WHOLE)
def test_a_whole_scene_is_edited_and_looks_as_in_cycles(name, whole):
    """Glass and metal on a textured floor, 204,800 faces in a hierarchy, a room with a window and a lamp."""
    size = {"file": str(whole / f"{name}.usdc"), "width": WHOLE_SIZE[0]}
    tables = {"scene": size, "input": {"width": 128}, "target": {"rotate_degrees": 60.0}}
    result = envedit.edit(config.from_dict(tables, whole))
    before, after = result.metrics["initial"]["psnr"], result.metrics["render"]["psnr"]
    cycles, ours = blender.read(whole / f"{name}.exr"), result.renders["initial"]
    # Cut at white: a lamp is seen in one only.
    stops = np.log2(np.minimum(ours, 1).mean() / np.minimum(cycles, 1).mean())
    shown = [tonemap(picture, "srgb") for picture in (ours, cycles, result.renders["target"], result.render)]
    images.write_png(whole / f"{name}.png", np.concatenate(shown, axis=1))
    error = np.abs(shown[0] - shown[1]).mean()
    print(f"{name}: {stops:+.3f} stops, {error:.3f} of white apart; edited {before:.1f} -> {after:.1f} dB")
    assert abs(stops) < 0.1 and error < 0.03 and after > before + 6
