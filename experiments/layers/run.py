r"""Turn real maps by 60 and by 140 degrees, layers and robust SIREN on the same work: a table of all of it.

    ENVEDIT_DATA=... python -m experiments.layers.run [--out runs/layers] [--kinds layers siren] \
        [--maps NAME ...] [--scenes sphere statue] [--angles 60 140] [--set table.key=value ...]

Every run is ``python -m envedit.run`` with its own folder; one that is done (it has metrics.json) is skipped.
``python -m experiments.layers.sheet`` draws the contact sheets.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance
from envedit.images import images
from envedit.losses import metrics
from experiments import puresky, trials

SUNNY = 1000.0
"""Peak radiance, 256 texels wide, from which on a map is called sunny."""
LIGHT_DEGREES = 6.0
"""The flux of a light is what lies within this angle of the true map's brightest texel."""
NAMES = {"layers": "layers", "siren": "R-SIREN"}
SCENES = {"sphere": "parameters = { roughness = 0.3 }\n", "statue": ""}


def jobs(out: Path, names, scenes, angles, kinds):
    """Yield (map, scene, angle, kind, folder, configuration) of every run."""
    for scene in scenes:
        for angle in angles:
            for name, file in puresky.of_script(names).items():
                for kind in kinds:
                    text = (
                        f'[input]\nenvmap = "{file}"\nwidth = 256\n[scene]\nfile = "{scene}"\n'
                        f"{SCENES[scene]}[target]\nrotate_degrees = {angle}\n"
                        f'[representation]\nkind = "{kind}"\n'
                    )
                    yield name, scene, angle, kind, out / f"{name}-{scene}-{angle}-{kind}", text


def measure(folder: Path, file: Path, angle: float) -> dict | None:
    """Return what the table shows of one run, None where it has not ended.

    Beside its metrics: the peak of the original; flux of the light over that of the true map's; energy of
    high frequencies over the original's (metrics.high_frequency_energy: log luminance less its 5 x 5 binomial
    blur), and the same of the true map, which a turn by part of a texel changes; active rows all.
    """
    if not (folder / "metrics.json").exists():
        return None
    found = json.loads((folder / "metrics.json").read_text())
    original, _ = images.load_envmap(str(file), 256)
    first, last = found["active_rows"]
    rows = slice(first, last + 1)
    edited = images.read(str(folder / "edited.exr"))[0]
    true = latlong.rotate(original, angle)
    directions = latlong.directions(*true.shape[:2])[rows]
    omega = latlong.solid_angles(*true.shape[:2])[rows, None]
    row, column = metrics.peak_position(true[rows])
    near = directions @ directions[row, column] > np.cos(np.radians(LIGHT_DEGREES))
    flux = [float((luminance(m[rows]) * omega)[near].sum()) for m in (edited, true)]
    sharp = [metrics.high_frequency_energy(m[rows]) for m in (edited, original, true)]
    return {
        "peak": float(luminance(original[rows]).max()),
        "render": found["render"],
        "initial": found["initial"],
        "map": found["envmap"],
        "before": found["initial_envmap"],
        "off": found["sun_offset_texels"],
        "flux": flux[0] / flux[1],
        "sharp": sharp[0] / sharp[1],
        "true_sharp": sharp[2] / sharp[1],
        "timing": found["timing"],
    }


HEAD = (
    "| map | {} | rendering PSNR (unedited) | SSIM | map PSNR (unedited) | gain | SSIM (unedited) | "
    "light off, texels | flux | high frequencies (true map) | s |\n" + "|---" * 11 + "|"
)


def line(name, kind, m) -> str:
    """One row of the table."""
    sunny = m["peak"] > SUNNY
    light = f"{m['off']:.1f} | {m['flux']:.2f}" if sunny else "- | -"
    gain = m["map"]["psnr"] - m["before"]["psnr"]
    return (
        f"| {name}{' (sunny)' if sunny else ''} | {NAMES[kind]} | {m['render']['psnr']:.1f} "
        f"({m['initial']['psnr']:.1f}) | {m['render']['ssim']:.3f} | {m['map']['psnr']:.1f} "
        f"({m['before']['psnr']:.1f}) | {gain:+.1f} | {m['map']['ssim']:.3f} ({m['before']['ssim']:.3f}) | "
        f"{light} | {m['sharp']:.2f} ({m['true_sharp']:.2f}) | {m['timing']['total_s']:.0f} |"
    )


def summary(kind, found) -> list[str]:
    """Return rows of means and extremes over many runs."""
    lines = []
    for what, some in (
        ("sunny", [m for m in found if m["peak"] > SUNNY]),
        ("all", found),
    ):
        if not some:
            continue
        gains = [m["map"]["psnr"] - m["before"]["psnr"] for m in some]
        psnr, sharp = [m["render"]["psnr"] for m in some], [m["sharp"] for m in some]
        light = "- | -"
        if what == "sunny":
            flux = [m["flux"] for m in some]
            light = f"at most {max(m['off'] for m in some):.1f} | {min(flux):.2f} to {max(flux):.2f}"
        lines.append(
            f"| **{what}, {len(some)} runs** | {NAMES[kind]} "
            f"| mean {np.mean(psnr):.1f}, worst {min(psnr):.1f} "
            f"| {np.mean([m['render']['ssim'] for m in some]):.3f} "
            f"| {np.mean([m['map']['psnr'] for m in some]):.1f} "
            f"| mean {np.mean(gains):+.1f}, worst {min(gains):+.1f} "
            f"| {np.mean([m['map']['ssim'] for m in some]):.3f} | {light} "
            f"| {min(sharp):.2f} to {max(sharp):.2f} "
            f"| median {np.median([m['timing']['total_s'] for m in some]):.0f} |"
        )
    return lines


def table(out: Path, names, scenes, angles, kinds) -> str:
    """Return all that has ended as Markdown: the summary first, then a table for each scene and angle."""
    files, parts, every = puresky.of_script(names), [], {kind: [] for kind in kinds}
    for scene in scenes:
        for angle in angles:
            rows = []
            for name, _, _, kind, folder, _ in jobs(out, names, [scene], [angle], kinds):
                if m := measure(folder, files[name], angle):
                    rows.append(line(name, kind, m))
                    every[kind].append(m)
            if rows:
                parts.append(f"{scene}, turned by {angle} degrees:\n\n{HEAD.format('')}\n" + "\n".join(rows))
    total = [row for kind, found in every.items() if found for row in summary(kind, found)]
    return "\n\n".join([f"{HEAD.format('')}\n" + "\n".join(total), *parts])


def main():
    """Compute and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/layers"))
    parser.add_argument("--maps", nargs="+", metavar="NAME")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--angles", nargs="+", type=int, default=[60, 140])
    parser.add_argument("--kinds", nargs="+", default=list(NAMES), choices=NAMES)
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="table.key=value")
    given = parser.parse_args()
    out = trials.folder(given.out.absolute(), given.overrides)
    out.mkdir(parents=True, exist_ok=True)
    work = given.maps, given.scenes, given.angles, given.kinds
    for name, scene, angle, kind, folder, text in jobs(out, *work):
        if (folder / "metrics.json").exists():
            continue
        config = folder.with_suffix(".toml")
        config.write_text(text)
        print(f"{name}, {scene}, {angle} degrees, {NAMES[kind]}", flush=True)
        command = [sys.executable, "-m", "envedit.run", str(config), "--out", str(folder), "--quiet"]
        subprocess.run([*command, *(part for o in given.overrides for part in ("--set", o))], check=False)
    text = table(out, *work)
    (out / "table.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
