"""The Blender extension, built and installed as a user does: edit, world, undo and errors, beside Cycles."""

import importlib.util
import json
import shutil
import sys

import numpy as np
import pytest

from envedit import config, inputs
from envedit.images import images
from envedit.scene import scene
from tests.oracles import ROOT, blender

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_cache")]

SIZE = 64, 48
STRENGTH = 1.5
SOURCE = ROOT / "envedit" / "integrations" / "blender"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
BROWSER = """
import sys
from playwright import sync_api

with sync_api.sync_playwright() as playwright:
    browser = playwright.chromium.launch(executable_path="CHROMIUM", args=["--no-sandbox"])
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    page.set_default_timeout(120_000)
    page.goto(sys.argv[1])
    sync_api.expect(page.locator("#status")).to_have_attribute("data-state", "done", timeout=120_000)
    page.locator("#tool-shadow").click()
    box = page.locator("#overlay").bounding_box()
    x, y = box["x"] + 0.4 * box["width"], box["y"] + 0.5 * box["height"]
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 0.2 * box["width"], y, steps=5)
    page.mouse.up()
    page.wait_for_function("() => envedit.log.some((e) => e.phase === 'done')")
    page.locator("#save").click()
    sync_api.expect(page.locator("#message")).to_contain_text("Saved in", timeout=240_000)
    browser.close()
open("DONE", "w").close()
"""
SCRIPT = """
import json, math, pathlib, subprocess, sys, time
from types import SimpleNamespace
import bpy
from mathutils import Vector

folder, source, command, browser = json.load(sys.stdin)
facts = {}

# ---- Build with Blender's own tool, install, enable
tool = pathlib.Path(bpy.utils.system_resource("SCRIPTS"), "addons_core/bl_pkg/cli/blender_ext.py")
build = ["build", "--source-dir", source, "--output-filepath", folder + "/envedit.zip"]
subprocess.run([sys.executable, str(tool), *build], check=True)
bpy.ops.extensions.package_install_files(
    filepath=folder + "/envedit.zip", repo="user_default", enable_on_install=True)
name = "bl_ext.user_default.envedit"
extension, preferences = sys.modules[name], bpy.context.preferences.addons[name].preferences

# ---- A grey sphere in a world of strength 1.5, turned by 40 degrees; two cameras
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.preferences.addon_enable(module=name)
preferences = bpy.context.preferences.addons[name].preferences
preferences.command = command
here = bpy.context.scene
grey = bpy.data.materials.new("grey")
grey.use_nodes = True
surface = grey.node_tree.nodes["Principled BSDF"]
surface.inputs["Base Color"].default_value = (0.5, 0.5, 0.5, 1)
surface.inputs["Specular IOR Level"].default_value = 0
bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32)
bpy.ops.object.shade_smooth()
bpy.context.object.data.materials.append(grey)
bpy.ops.object.camera_add(location=(5, 5, 5))
bpy.ops.object.camera_add(location=(1, -4, 1.5))
here.camera = bpy.context.object
here.camera.rotation_euler = (-here.camera.location).to_track_quat("-Z", "Y").to_euler()
use_cycles(here, SIZE)


def error(operator):
    try:
        operator()
    except RuntimeError as reason:
        return str(reason).strip()


def end():
    while (wait := extension.poll()) is not None:
        time.sleep(wait)


def render(name):
    here.render.filepath = folder + "/" + name
    bpy.ops.render.render(write_still=True)


def texture():
    return bpy.data.worlds["world"].node_tree.nodes["sky"]


class Layout:  # draws by looking up what it draws
    def prop(self, owner, key):
        owner.bl_rna.properties[key]

    def operator(self, key, icon):
        getattr(bpy.ops.envedit, key.split(".")[1]).get_rna_type()

    def label(self, text):
        facts["label"] = text


def draw():
    panel = SimpleNamespace(layout=Layout())
    extension.ENVEDIT_PT_light.draw(panel, bpy.context)


# ---- Errors before a process starts
paint = bpy.ops.envedit.paint
facts["unsaved"] = error(paint)
bpy.ops.wm.save_as_mainfile(filepath=folder + "/scene.blend")
here = bpy.context.scene
facts["no world"] = error(paint)
here.world = bpy.data.worlds.new("world")
here.world.use_nodes = True
nodes, links = here.world.node_tree.nodes, here.world.node_tree.links
nodes["Background"].inputs["Strength"].default_value = 1.5
facts["no texture"] = error(paint)
picture, turn = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeMapping")
picture.name = "sky"
turn.inputs["Rotation"].default_value = (0, 0, math.radians(40))
links.new(nodes.new("ShaderNodeTexCoord").outputs["Generated"], turn.inputs["Vector"])
links.new(turn.outputs["Vector"], picture.inputs["Vector"])
links.new(picture.outputs["Color"], nodes["Background"].inputs["Color"])
facts["no image"] = error(paint)
picture.image = bpy.data.images.load(folder + "/sky.exr")
preferences.command = folder + "/nowhere"
facts["no envedit"] = error(paint)
preferences.command = command

# ---- An error of envedit
here.envedit.width = SIZE[0]
here.envedit.target = folder + "/nothing.exr"
bpy.ops.envedit.match()
facts["no target"] = error(end)

# ---- Painted in the browser that envedit opens; it goes on until it is ended
if browser:
    bpy.ops.envedit.paint()
    draw()
    facts["second"] = error(paint)
    last = time.monotonic() + 300
    while not pathlib.Path(folder, "done").exists() or texture().image.filepath == folder + "/sky.exr":
        assert extension.poll() and time.monotonic() < last
        time.sleep(0.2)
    facts["painted"] = texture().image.filepath
    bpy.ops.envedit.end()
    texture().image = bpy.data.images["sky.exr"]

# ---- An edit, taken, undone and redone
render("before.exr")
here.envedit.target = folder + "/target.exr"
bpy.ops.ed.undo_push(message="before")
bpy.ops.envedit.match()
end()
facts["edited"] = texture().image.filepath
facts["worlds"] = len(bpy.data.worlds)
bpy.ops.ed.undo()
facts["undone"] = texture().image.filepath
bpy.ops.ed.redo()
facts["redone"] = texture().image.filepath
here = bpy.context.scene
render("after.exr")

# ---- The same edit, taken with sun lamps, twice; and what the next export says of them
here.envedit.lamps = True
bpy.ops.ed.undo_push(message="before lamps")
edit = str(pathlib.Path(bpy.path.abspath(facts["edited"])).parent)
for _ in range(2):
    bpy.ops.envedit.take("EXEC_DEFAULT", True, scene=here.name, folder=edit)
facts["lamps"] = sum(thing.type == "LIGHT" for thing in bpy.data.objects)
render("lamps.exr")
exchange = sys.modules[name + ".exchange"]
exchange.export(bpy.context.scene, pathlib.Path(folder, "lamps.usdc"))
bpy.ops.ed.undo()
bpy.ops.ed.undo()
facts["lamps undone"] = sum(thing.type == "LIGHT" for thing in bpy.data.objects)
bpy.ops.preferences.addon_disable(module=name)
facts["edit"] = edit
pathlib.Path(folder, "facts.json").write_text(json.dumps(facts))
"""


@pytest.fixture(scope="module")
def edited(tmp_path_factory):
    """Return a folder with Cycles' pictures and what the script noted; the edit is a tiny one."""
    pytest.importorskip("pxr", reason="the extra envedit[usd] is not installed")
    folder = tmp_path_factory.mktemp("extension")
    for name, place in (("sky", (40, 100)), ("target", (40, 130))):
        sky = np.full((128, 256, 3), 0.1, np.float32)
        sky[place] = 8000
        images.write_exr(folder / f"{name}.exr", sky)
    command = folder / "command"
    start = f'PYTHONPATH="{ROOT}" exec "{sys.executable}" -m envedit "$@"'
    command.write_text(f"#!/bin/sh\n{start}\n")
    command.chmod(0o755)
    (folder / "browser.py").write_text(
        BROWSER.replace("CHROMIUM", str(CHROMIUM)).replace("DONE", f"{folder}/done")
    )
    browser = bool(CHROMIUM and importlib.util.find_spec("playwright"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BLENDER_USER_RESOURCES", str(folder / "user"))
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        patch.setenv("BROWSER", f"{sys.executable} {folder}/browser.py %s")
        script = SCRIPT.replace("SIZE", str(SIZE))
        blender.run(script, json.dumps([str(folder), str(SOURCE), str(command), browser]))
    return folder, json.loads((folder / "facts.json").read_text())


def test_errors_are_reported_in_one_line(edited):
    folder, facts = edited
    assert "save the .blend file first" in facts["unsaved"]
    assert "no world" in facts["no world"]
    assert "connect an Environment Texture" in facts["no texture"]
    assert "no image file" in facts["no image"]
    assert "nowhere: No such file or directory; name the command envedit" in facts["no envedit"]
    assert (
        facts["no target"].startswith("Error: exit code 3: envedit: ") and "nothing.exr" in facts["no target"]
    )


def test_a_painting_that_is_saved_becomes_the_world(edited):
    folder, facts = edited
    if "painted" not in facts:
        pytest.skip("no chromium on this machine, or no playwright")
    assert "poll() failed" in facts["second"] and "envedit runs in" in facts["label"]
    name = facts["painted"].replace("//", f"{folder}/")
    before, after = (images.load_envmap(file)[0] for file in (str(folder / "sky.exr"), name))
    assert np.abs(after - before).max() > 0.01 and np.isfinite(after).all()


def test_the_edit_becomes_the_world_and_undo_takes_it_back(edited):
    folder, facts = edited
    assert facts["edited"] == facts["redone"] != facts["undone"] == str(folder / "sky.exr")
    assert facts["edited"].startswith("//envedit/edit_") and facts["worlds"] == 1
    assert facts["lamps"] == 1 and facts["lamps undone"] == 0


def test_cycles_shows_the_light_of_mitsuba_before_and_after(edited):
    folder, facts = edited
    shot = scene.load(f"{facts['edit']}/shot.usdc", SIZE[0])
    first = inputs.read_map(config.Input(envmap="auto", width=256), shot).radiance
    last = STRENGTH * images.load_envmap(f"{facts['edit']}/shot_out/edited.exr")[0]
    with_lamp = scene.load(folder / "lamps.usdc", SIZE[0])
    rest = inputs.read_map(config.Input(envmap="auto", width=256), with_lamp).radiance
    pictures = [blender.read(folder / f"{name}.exr") for name in ("before", "after", "lamps")]
    ours = [shot.render(first, 256), shot.render(last, 256)]
    for picture, cycles in zip(
        [*ours, ours[1], with_lamp.render(rest, 256)], [*pictures, pictures[2]], strict=True
    ):
        angle, stops = blender.difference(shot, SIZE, picture, cycles)
        print(f"{angle:.2f} degrees, {stops:+.3f} stops")
        assert angle < 1 and abs(stops) < 0.1
    moved, _ = blender.difference(shot, SIZE, ours[0], pictures[1])
    assert moved > 20
