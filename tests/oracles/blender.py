"""Blender's Cycles beside Mitsuba: the interpreter that has ``bpy``, and the light that a picture shows."""

import os
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest

CYCLES = '''
def use_cycles(scene, size):
    """Render by Cycles, without what changes radiance, as linear OpenEXR."""
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 256
    scene.cycles.sample_clamp_indirect = 0
    scene.cycles.use_denoising = False
    scene.render.threads_mode = "FIXED"
    scene.render.threads = 2
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
'''
"""What every script has: settings of Cycles."""


def run(script, text=""):
    """Run a script with ``bpy`` in an interpreter of its own, and return what it printed.

    ``ENVEDIT_BPY`` names the interpreter, by default this one; without bpy the test is skipped.
    """
    python = os.environ.get("ENVEDIT_BPY", sys.executable)
    if subprocess.run([python, "-c", "import bpy"], capture_output=True).returncode:
        pytest.skip("bpy is not installed: ENVEDIT_BPY names a Python that has it")
    # The variables of this process are not Blender's: it has a Python path of its own.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [python, "-c", CYCLES + script], input=text, text=True, capture_output=True, env=environment
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def read(path):
    return np.array(mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB))


def normals(found, size):
    """Return the normal in every pixel, (h, w, 3), and whether a surface is seen there and around it."""
    width, height = size
    columns, rows = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    position = mi.Point2f(columns.ravel().astype(np.float32), rows.ravel().astype(np.float32))
    ray, _ = found.mi.sensors()[0].sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    seen = found.mi.ray_intersect(ray)
    normal = np.array(mi.Vector3f(seen.sh_frame.n)).T.reshape(height, width, 3)
    valid = np.array(seen.is_valid()).reshape(height, width)
    around = [np.roll(valid, step, axis) for axis in (0, 1) for step in (1, -1)]
    return normal, valid & np.all(around, axis=0)


def difference(found, size, ours, cycles):
    """Return the angle between the lights of two pictures (h, w, 3) in degrees, and their ratio in stops.

    The light of a picture is a vector by which radiance = normal . light + constant, where it shines.
    """
    normal, inside = normals(found, size)
    pictures = [picture.mean(axis=2) for picture in (ours, cycles)]
    bright = inside & np.all([picture > 0.3 * picture.max() for picture in pictures], axis=0)
    assert bright.sum() > 200
    basis = np.concatenate([normal[bright], np.ones((bright.sum(), 1))], axis=1)
    lights = [np.linalg.lstsq(basis, picture[bright], rcond=None)[0][:3] for picture in pictures]
    strength = np.prod([np.linalg.norm(light) for light in lights])
    angle = np.degrees(np.arccos(np.clip(lights[0] @ lights[1] / strength, -1, 1)))
    return angle, np.log2(pictures[0][inside].mean() / pictures[1][inside].mean())
