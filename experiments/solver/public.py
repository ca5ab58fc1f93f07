r"""Edit scenes that nobody here made, under every sky: turned maps and other maps as targets.

    ENVEDIT_DATA=... python -m experiments.solver.public [--out runs/public] \
        [--scenes matpreview principled] [--maps NAME ...] [--set table.key=value ...]

Every run is ``python -m envedit.run`` with its own folder; one that is done (it has metrics.json) is skipped.
Writes table.md and a contact sheet for each scene: original, true map, edited map, target, edited rendering.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance
from envedit.images import images
from experiments import puresky, trials

SCENES = {"matpreview": "matpreview/matpreview.xml", "principled": "principled/scene.xml"}
ANGLES, OTHERS = (60, 140), (1, 4, 8)
"""Turns in degrees, and how many names farther on in the alphabet the other maps are."""


def jobs(out: Path, scenes, names):
    """Yield (scene, map, target, folder, configuration, file of the map, file of the target or angle)."""
    files = puresky.of_script(None)
    every = sorted(files)
    root = Path(os.environ["ENVEDIT_DATA"]) / "scenes"
    for scene in scenes:
        for name in names or every:
            i = every.index(name)
            targets = {f"{angle}": angle for angle in ANGLES}
            targets |= {every[(i + k) % len(every)]: files[every[(i + k) % len(every)]] for k in OTHERS}
            for label, target in targets.items():
                asked = f"rotate_degrees = {target}" if isinstance(target, int) else f'file = "{target}"'
                text = (
                    f'[input]\nenvmap = "{files[name]}"\nwidth = 256\n'
                    f'[scene]\nfile = "{root / SCENES[scene]}"\n'
                    f"width = 128\n[target]\n{asked}\n"
                )
                yield scene, name, label, out / f"{scene}-{name}-{label}", text, files[name], target


HEAD = (
    "| scene | map | target | rendering (unedited), dB | map (unedited), dB | colours outside | seam | "
    "high frequencies | solve, s |\n" + "|---" * 9 + "|"
)


def line(scene, name, label, found) -> str:
    """One row of the table."""
    natural = found["natural"]
    return (
        f"| {scene} | {name} | {label} | {found['render']['psnr']:.1f} ({found['initial']['psnr']:.1f}) | "
        f"{found['envmap']['psnr']:.1f} ({found['initial_envmap']['psnr']:.1f}) | "
        f"{100 * natural['colours_outside']:.1f} % | {natural['seam']:.1f} | "
        f"{natural['high_frequency']:.2f} | {found['timing']['solve_s']:.1f} |"
    )


def summary(rows) -> list[str]:
    """Return means and extremes of turned and of other targets."""
    lines = []
    for what, some in (
        ("turned", [f for _, _, label, f in rows if label.isdigit()]),
        ("another map", [f for _, _, label, f in rows if not label.isdigit()]),
    ):
        if some:
            gain = [f["envmap"]["psnr"] - f["initial_envmap"]["psnr"] for f in some]
            outside = [100 * f["natural"]["colours_outside"] for f in some]
            render, solve = [f["render"]["psnr"] for f in some], [f["timing"]["solve_s"] for f in some]
            lines.append(
                f"- {what}, {len(some)} runs: rendering {np.mean(render):.1f} dB (worst {min(render):.1f}), "
                f"map {np.mean(gain):+.1f} dB over the unedited one (worst {min(gain):+.1f}, below 0 in "
                f"{sum(g < 0 for g in gain)}), colours outside {np.mean(outside):.1f} % "
                f"(most {max(outside):.1f} %, over 5 % in {sum(o > 5 for o in outside)}), "
                f"solve median {np.median(solve):.1f} s"
            )
    return lines


def sheet(path: Path, done) -> None:
    """Draw a row for each run."""
    rows = []
    for folder, file, target in done:
        original, _ = images.load_envmap(str(file), 256)
        true = (
            latlong.rotate(original, target)
            if isinstance(target, int)
            else images.load_envmap(target, 256)[0]
        )
        maps = [original, true, images.read(str(folder / "edited.exr"))[0]]
        white = 4 * float(np.median(luminance(maps[1])))
        pictures = [images.read(str(folder / f"render_{n}.exr"))[0] for n in ("target", "edited")]
        tiles = [np.clip(m / white, 0, 1) ** (1 / 2.2) for m in maps]
        for picture in pictures:
            shown = np.clip(picture, 0, 1) ** (1 / 2.2)
            high = np.zeros((128, shown.shape[1], 3))
            high[: min(128, len(shown))] = shown[:128]
            tiles.append(high)
        rows.append(np.pad(np.concatenate(tiles, axis=1), ((0, 3), (0, 0), (0, 0))))
    pixels = (np.concatenate(rows) * 255 + 0.5).astype(np.uint8)
    path.write_bytes(images.png(pixels))


def main():
    """Compute, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/public"))
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--maps", nargs="+", metavar="NAME")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="table.key=value")
    given = parser.parse_args()
    out = trials.folder(given.out.absolute(), given.overrides)
    out.mkdir(parents=True, exist_ok=True)
    rows, done = [], {scene: [] for scene in given.scenes}
    for scene, name, label, folder, text, file, target in jobs(out, given.scenes, given.maps):
        if not (folder / "metrics.json").exists():
            config = folder.with_suffix(".toml")
            config.write_text(text)
            print(f"{scene}, {name}, {label}", flush=True)
            command = [sys.executable, "-m", "envedit.run", str(config), "--out", str(folder), "--quiet"]
            subprocess.run([*command, *(part for o in given.overrides for part in ("--set", o))], check=False)
        if (folder / "metrics.json").exists():
            rows.append((scene, name, label, json.loads((folder / "metrics.json").read_text())))
            done[scene].append((folder, file, target))
    text = "\n".join([*summary(rows), "", HEAD, *(line(*row) for row in rows)])
    (out / "table.md").write_text(text + "\n")
    print(text)
    for scene, some in done.items():
        if some:
            sheet(out / f"{scene}.png", some)
            print(out / f"{scene}.png")


if __name__ == "__main__":
    main()
