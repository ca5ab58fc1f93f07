"""A scene of Blender out as USD for envedit, and the edited map back into its world.

Used by the extension and by scripts (docs/blender.md).
"""

import contextlib
import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import bpy

OPTIONS = {"generate_materialx_network": True, "export_subdivision": "TESSELLATE"}
"""Of Blender's exporter: without them glass is not glass, and a mesh is its control cage."""
SUN_EXPORTED = 0.25
"""Share of its strength with which the exporter writes a sun lamp (Blender 5.0.1; docs/blender.md)."""
MARK = "envedit"
"""Custom property of the sun lamps of an edit: the folder of its results."""


class ExchangeError(Exception):
    """What a user can change: one line for Blender's report."""


class Sky(NamedTuple):
    """What lights a world: the node of its map, the map's rotation (radians), the factor of its radiance."""

    texture: bpy.types.Node
    rotation: tuple[float, float, float]
    factor: float


def read_sky(world: bpy.types.World | None) -> Sky:
    """Return what lights a world.

    Read are an *Environment Texture* (equirectangular) of a file, in the *Background* of the output; at
    its Vector a *Mapping* that only rotates; at its Color a *Vector Math* node, Multiply by equal numbers.
    ExchangeError if there is no world, or it has other nodes.
    """
    if world is None or world.node_tree is None:
        raise ExchangeError("the scene has no world with nodes: give it one with an Environment Texture")
    name = f"world {world.name}"
    background = _source(world.node_tree.get_output_node("ALL"), "Surface")
    if background is None or background.type != "BACKGROUND" or background.inputs["Strength"].is_linked:
        raise ExchangeError(f"{name}: connect a Background of constant strength to its output")
    factor = background.inputs["Strength"].default_value
    texture = _source(background, "Color")
    if texture is not None and texture.type == "VECT_MATH" and texture.operation == "MULTIPLY":
        factors = set(texture.inputs[1].default_value)
        if texture.inputs[1].is_linked or len(factors) > 1:
            raise ExchangeError(f"{name}: multiply its map by three equal numbers, not by a colour")
        factor *= factors.pop()
        texture = _source(texture, 0)
    if texture is None or texture.type != "TEX_ENVIRONMENT" or texture.projection != "EQUIRECTANGULAR":
        raise ExchangeError(f"{name}: connect an Environment Texture (equirectangular) to its Background")
    image = texture.image
    if image is None or image.source != "FILE" or not (image.packed_file or _file(image).is_file()):
        raise ExchangeError(f"{name}: its Environment Texture has no image file; open one in it")
    mapping = _source(texture, "Vector")
    if mapping is None or mapping.type == "TEX_COORD":
        return Sky(texture, (0.0, 0.0, 0.0), factor)
    if not _only_rotates(mapping):
        raise ExchangeError(f"{name}: its map may only be turned, by the Rotation of a Mapping node (Point)")
    return Sky(texture, tuple(mapping.inputs["Rotation"].default_value), factor)


def _source(node, key):
    """Return the node that is connected to an input, or None."""
    links = node.inputs[key].links if node else ()
    return links[0].from_node if links else None


def _file(image):
    return Path(bpy.path.abspath(image.filepath, library=image.library))


def _only_rotates(node):
    if node.type != "MAPPING" or node.vector_type != "POINT":
        return False
    if any(socket.is_linked for socket in node.inputs[1:]):
        return False
    return not any(node.inputs["Location"].default_value) and set(node.inputs["Scale"].default_value) == {1}


# ----------------------------------------------------------------------------------------------------------
# Out


def export(scene: bpy.types.Scene, file: Path, camera: bpy.types.Object | None = None) -> None:
    """Write a USD file of what one camera, by default the scene's, sees; afterwards the scene is as before.

    ``scene`` is that of the context. Textures are copied to ``textures`` beside ``file``. ExchangeError if
    there is no camera, :func:`read_sky` does not read the world, or Blender cannot write the file.
    """
    camera = camera or scene.camera
    if camera is None:
        raise ExchangeError("the scene has no camera: add one")
    with _prepared(scene, camera, read_sky(scene.world)):
        try:
            bpy.ops.wm.usd_export(filepath=str(file), **OPTIONS)
        except RuntimeError as error:
            raise ExchangeError(f"USD export: {str(error).strip()}") from error


@contextlib.contextmanager
def _prepared(scene, camera, sky) -> Iterator[None]:
    """Give a scene one camera, and world and suns of which Blender's exporter writes what Cycles shows."""
    user, world = scene.world, bpy.data.worlds.new("envedit")
    hidden = {thing: thing.hide_render for thing in scene.objects if thing.type == "CAMERA"}
    lamps = [thing.data for thing in scene.objects if thing.type == "LIGHT"]
    energy = {lamp: lamp.energy for lamp in lamps if lamp.type == "SUN"}
    try:
        _fill(world, sky)
        scene.world = world
        for thing in hidden:
            thing.hide_render = thing != camera
        for lamp in energy:
            lamp.energy = energy[lamp] / SUN_EXPORTED
        yield
    finally:
        scene.world = user
        bpy.data.worlds.remove(world)
        for thing in hidden:
            thing.hide_render = hidden[thing]
        for lamp in energy:
            lamp.energy = energy[lamp]


def _fill(world, sky):
    """Make the nodes of a world: without a Mapping node the exporter lays the sky on its side.

    It leaves out the strength (Blender 5.0.1), which is here a factor of the colour.
    """
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    background = next(node for node in nodes if node.type == "BACKGROUND")
    background.inputs["Strength"].default_value = 1
    texture = nodes.new("ShaderNodeTexEnvironment")
    texture.image = sky.texture.image
    turn = nodes.new("ShaderNodeMapping")
    turn.inputs["Rotation"].default_value = sky.rotation
    factor = nodes.new("ShaderNodeVectorMath")
    factor.operation = "MULTIPLY"
    factor.inputs[1].default_value = 3 * [sky.factor]
    links.new(nodes.new("ShaderNodeTexCoord").outputs["Generated"], turn.inputs["Vector"])
    links.new(turn.outputs["Vector"], texture.inputs["Vector"])
    links.new(texture.outputs["Color"], factor.inputs[0])
    links.new(factor.outputs[0], background.inputs["Color"])


# ----------------------------------------------------------------------------------------------------------
# In


def take(scene: bpy.types.Scene, results: Path, lamps: bool = False, relative: bool = False) -> None:
    """Set a scene's world to an edited map; its rotation and factor stay.

    ``results`` is the folder of an ``envedit run``. The map is copied to ``world_1.exr`` and so on beside it:
    the next save does not change what undo goes back to. ``lamps``: take the lights of the map as sun lamps,
    in place of those of an earlier take of the same results, and its sky, at working resolution, as the
    world. ``relative``: name the map relative to the .blend file. ExchangeError if the world or the results
    cannot be read.
    """
    texture = read_sky(scene.world).texture
    names = ("edited_sky.exr",) if lamps else ("edited_full.exr", "edited.exr")
    try:
        copy = _copy(next(results / name for name in names if (results / name).is_file()))
        lights = json.loads((results / "lights.json").read_text(encoding="utf-8"))["after"] if lamps else []
        image = bpy.data.images.load(bpy.path.relpath(str(copy)) if relative else str(copy))
    except (StopIteration, OSError, ValueError, RuntimeError) as error:
        raise ExchangeError(f"{results}: no edited map that can be read; {error}") from error
    image.colorspace_settings.name = texture.image.colorspace_settings.name
    texture.image = image
    for lamp in [thing for thing in scene.objects if thing.get(MARK) == str(results)]:
        bpy.data.objects.remove(lamp)
    for light in lights:
        if max(light["flux"]) > 0:
            _add_sun(scene, light)[MARK] = str(results)


def _copy(file):
    """Copy a map to the next free name beside the folder that it is in."""
    number = 1
    while (copy := file.parent.with_name(f"world_{number}.exr")).exists():
        number += 1
    shutil.copyfile(file, copy)
    return copy


def _add_sun(scene, light):
    """Add a sun lamp for a light of ``lights.json``, whose flux is the irradiance where it is faced."""
    strength = max(light["flux"])
    lamp = bpy.data.lights.new("Environment sun", "SUN")
    lamp.energy = strength
    lamp.color = [channel / strength for channel in light["flux"]]
    lamp.angle = min(math.radians(light["angle"]), math.pi)
    thing = bpy.data.objects.new(lamp.name, lamp)
    x, y, z = light["direction"]  # in Blender's axes, which the exporter keeps
    thing.rotation_euler = (math.atan2(math.hypot(x, y), z), 0, math.atan2(x, -y))
    scene.collection.objects.link(thing)
    return thing
