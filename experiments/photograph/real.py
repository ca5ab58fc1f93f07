"""Two real photographs, a rough scene of each, and a ball put into one: ``-m experiments.photograph.real``.

The photographs are of scikit-image's wheel, which pip fetches: ``coffee.png`` (Rachel Michetti, CC0) and
``astronaut.png`` (NASA, public domain). They and all results go to a folder.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import mitsuba as mi
import numpy as np

import envedit
from envedit.core import latlong
from envedit.core.atomic_files import make_folder
from envedit.core.color import tonemap
from envedit.images import images
from envedit.results import Result
from experiments import puresky
from experiments.harness import montage
from experiments.photograph import insertion

WHEEL = "scikit-image==0.26.0"
SCENES = Path(__file__).parent / "scenes"
STUDIO = "hdri/studio_small_03_1k.hdr"
SIZES = {"coffee": (150, 100), "astronaut": (96, 96)}
"""Width and height of the renderings."""
HORIZON = {"coffee": "auto", "astronaut": "free"}
"""A table hides the light from below; without one, lights at any height move whole."""
SIDES = 48
PROFILES = {
    "ball": [(np.cos(v), np.sin(v)) for v in np.linspace(-1.57, 1.57, 24)],
    "saucer": [(0.4, 0), (0.66, 0.03), (0.93, 0.12), (0.955, 0.135), (0.93, 0.14), (0.66, 0.075), (0, 0.05)],
    "cup_outside": [(0.25, 0.06), (0.32, 0.1), (0.39, 0.28), (0.44, 0.5), (0.47, 0.8)],
    "cup_inside": [
        (0.47, 0.8),
        (0.495, 0.83),
        (0.49, 0.86),
        (0.465, 0.87),
        (0.44, 0.86),
        (0.42, 0.8),
        (0.36, 0.42),
    ],
}
"""Radius and height of points on surfaces of revolution, so that their front is on the right upwards."""
INSERTED = insertion.ball(x=1.1, z=-0.55, radius=0.2, colour="0.05, 0.25, 0.3", alpha=0.05)


def main() -> None:
    """Fetch the photographs, edit a studio's light towards each, insert the ball, draw ``sheet.jpg``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="for photographs, scenes and results")
    folder = make_folder(parser.parse_args().folder)
    prepare(folder)
    results = {name: edited(name, folder) for name in SIZES}
    insert_ball(results["coffee"], folder)
    draw(folder)


def draw(folder: Path) -> None:
    """Write ``sheet.jpg``, of files: photograph, rendering, outliers, the map before and after, the ball."""
    studio = images.read(puresky.data(STUDIO) / STUDIO)[0]
    rows = []
    for name in SIZES:
        edited_map = images.read(folder / name / "edited.exr")[0]
        pictures = [images.read_stored(folder / name / "photograph.png")[0] / 255]
        pictures += [tonemap(latlong.resize(one, 200, 400) / 4, "gamma") for one in (studio, edited_map)]
        if name == "coffee":
            pictures.append(images.read_stored(folder / "inserted.png")[0] / 255)
        rows.append(pictures)
    mi.Bitmap(montage(rows)).write(str(folder / "sheet.jpg"), quality=85)


def prepare(folder: Path) -> None:
    """Write photographs, scenes and meshes."""
    command = ["pip", "download", "-q", "--no-deps", "--only-binary", ":all:", "-d", str(folder), WHEEL]
    subprocess.run([sys.executable, "-m", *command], check=True)
    with zipfile.ZipFile(next(folder.glob("scikit_image-*.whl"))) as wheel:
        for name in SIZES:
            (folder / f"{name}.png").write_bytes(wheel.read(f"skimage/data/{name}.png"))
    shutil.copytree(SCENES, folder, dirs_exist_ok=True)
    angles = 2 * np.pi * np.arange(SIDES) / SIDES
    for name, profile in PROFILES.items():
        lines = [
            f"v {r * np.cos(a):.4f} {height:.4f} {-r * np.sin(a):.4f}"
            for r, height in profile
            for a in angles
        ]
        for ring in range(0, (len(profile) - 1) * SIDES, SIDES):
            for k in range(SIDES):
                this, following = ring + k + 1, ring + (k + 1) % SIDES + 1
                lines.append(f"f {this} {following} {following + SIDES} {this + SIDES}")
        (folder / f"{name}.obj").write_text("\n".join(lines) + "\n")


def edited(name: str, folder: Path) -> Result:
    """Edit a studio's light towards a photograph, and save the result."""
    width, height = SIZES[name]
    settings = {
        "input": {"envmap": str(puresky.data(STUDIO) / STUDIO), "width": 128, "horizon": HORIZON[name]},
        "scene": {"file": str(folder / f"{name}.xml"), "width": width, "height": height},
        "target": {"kind": "photo", "file": str(folder / f"{name}.png")},
    }
    if name == "astronaut":  # the scene lacks flag, model and table
        settings["target"]["mask"] = str(folder / "astronaut_mask.png")
    result = envedit.edit(settings)
    result.save(folder / name)
    print(f"{name}: {result.photo.summary}, {result.metrics['timing']['total_s']:.0f} s")
    return result


def insert_ball(result: Result, folder: Path) -> None:
    """Write ``inserted.png``: the coffee with the ball, twice as large as the rendering."""
    width, height = 2 * SIZES["coffee"][0], 2 * SIZES["coffee"][1]
    scene = (folder / "coffee.xml").read_text()
    first = '<bsdf type="roughplastic" id="wood">'
    scenes = insertion.scenes_of(scene, first, INSERTED, folder, width, height)
    photo = result.photo.laid((height, width))
    without, with_object = (
        scenes[name].render(result.maps["edited"], insertion.SPP) for name in ("without", "with")
    )
    outline = scenes["alone"].alpha[..., None]
    shown = photo.camera.shown(insertion.composed(photo.picture, outline, with_object, without))
    images.write_png(folder / "inserted.png", shown)


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    main()
