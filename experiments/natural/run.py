r"""Edit many skies in many scenes, and tell whether what comes out still looks like a photograph of a sky.

    ENVEDIT_DATA=... python -m experiments.natural.run [--out runs/natural] [--only TEXT ...] [--count N] \
        [--quick] [--set table.key=value ...]

Every PureSky map, the maps with ground and the analytic sky, in five scenes, towards: the map turned by 60
and 140 degrees; three other PureSky maps; of the analytic sky its sun at other elevations instead of other
maps. With a turn of the sky allowed and without. Every run is ``python -m envedit.run`` with its own folder;
one that is done (it has metrics.json) is skipped. ``--only`` takes runs whose name has one of these texts in
it, ``--count`` as many of them as it says, evenly from all kinds of runs, ``--quick`` is ``--count 10``.
Writes table.md and a contact sheet for each scene: original, true map, edited map, target, edited rendering.
"""

import argparse
import hashlib
import itertools
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance
from envedit.images import analytic_sky, images
from experiments import puresky, trials

SCENES = {
    "sphere": "sphere",
    "statue": "statue",
    "mirror": "mirror",
    "matpreview": "matpreview/matpreview.xml",
    "principled": "principled/scene.xml",
}
ANGLES, OTHERS = (60, 140), (1, 4, 8)
"""Turns in degrees, and how many names farther on in the alphabet the other maps are."""
ELEVATIONS, ELEVATION = (5, 10, 20, 50, 65, 80), 35
"""Of the analytic sky's sun, degrees: targets, and before."""
WIDTH = 256
KINDS = "turned", "another map", "elevation"


@dataclass(frozen=True)
class Run:
    """One edit: names, TOML of map and target, and the true map (a file, or degrees of turn)."""

    scene: str
    map: str
    label: str
    kind: str
    turn: str
    source: str
    target: str | int

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.scene}-{self.map}-{self.label}-turn_{self.turn}"

    def configuration(self) -> str:
        """TOML."""
        file = SCENES[self.scene]
        if "/" in file:
            file = Path(os.environ["ENVEDIT_DATA"]) / "scenes" / file
        rough = "parameters = { roughness = 0.3 }\n" if self.scene == "sphere" else ""
        asked = f'file = "{self.target}"'
        if isinstance(self.target, int):
            asked = f"rotate_degrees = {self.target}"
        turn = '"auto"' if self.turn == "auto" else "false"
        return (
            f'[input]\nenvmap = "{self.source}"\nwidth = {WIDTH}\n[scene]\nfile = "{file}"\nwidth = 128\n'
            f"{rough}[target]\n{asked}\n[representation]\nturn = {turn}\n"
        )

    def maps(self):
        """Return the original and the true map."""
        original = images.load_envmap(self.source, WIDTH)[0]
        if isinstance(self.target, int):
            return original, latlong.rotate(original, self.target)
        return original, images.load_envmap(self.target, WIDTH)[0]


def runs(out: Path) -> list[Run]:
    """List every run."""
    skies = {name: str(file) for name, file in puresky.of_script(None).items()}
    names = sorted(skies)
    ground = sorted((Path(os.environ["ENVEDIT_DATA"]) / "hdri").glob("*_1k.hdr"))
    maps = skies | {file.stem.removesuffix("_1k"): str(file) for file in ground}
    analytic = {e: str(out / f"sunsky_{e}.exr") for e in (ELEVATION, *ELEVATIONS)}
    found = []
    for scene, (i, (name, source)), turn in itertools.product(
        SCENES, enumerate((maps | {"sunsky": analytic[ELEVATION]}).items()), ("auto", "false")
    ):
        for angle in ANGLES:
            found.append(Run(scene, name, str(angle), "turned", turn, source, angle))
        if name == "sunsky":
            for e in ELEVATIONS:
                found.append(Run(scene, name, f"elevation_{e}", "elevation", turn, source, analytic[e]))
            continue
        for k in OTHERS:
            other = names[(i + k) % len(names)]
            found.append(Run(scene, name, other, "another map", turn, source, skies[other]))
    return found


def evenly(found: list[Run], count: int) -> list[Run]:
    """Pick runs from all scenes, kinds and turns in the same number, in an order that is always the same."""
    strata: dict[tuple, list[Run]] = {}
    for run in sorted(found, key=lambda r: hashlib.sha256(r.name.encode()).hexdigest()):
        strata.setdefault((run.kind, run.turn, run.scene), []).append(run)
    # Neighbours in a round differ in all of scene, kind and turn.
    keys = sorted(strata, key=lambda key: hashlib.sha256(str(key).encode()).hexdigest())
    rounds = itertools.zip_longest(*(strata[key] for key in keys))
    return [run for some in rounds for run in some if run is not None][:count]


HEAD = (
    "| scene | map | target | turn | rendering (unedited), dB | map (unedited), dB | upper, lower half | "
    "sun off, texels | colours outside | seam | high frequencies |\n" + "|---" * 11 + "|"
)


def psnr(a, b) -> float:
    """PSNR of display values."""
    shown = [np.clip(np.float64(m), 0, 1) ** (1 / 2.2) for m in (a, b)]
    return float(-10 * np.log10(max(np.square(shown[0] - shown[1]).mean(), 1e-12)))


def measured(run: Run, folder: Path) -> dict:
    """Return what the table shows of a run that has ended."""
    found = json.loads((folder / "metrics.json").read_text())
    original, true = run.maps()
    edited, half = images.read(str(folder / "edited.exr"))[0], WIDTH // 4
    found["gain"] = found["envmap"]["psnr"] - found["initial_envmap"]["psnr"]
    found["halves"] = [
        psnr(edited[rows], true[rows]) - psnr(original[rows], true[rows])
        for rows in (slice(0, half), slice(half, None))
    ]
    return found


def line(run: Run, m: dict) -> str:
    """One row of the table."""
    natural = m["natural"]
    off, seam, sharp = (
        "-" if v is None else f"{v:.{n}f}"
        for v, n in (
            (m.get("sun_offset_texels"), 1),
            (natural["seam"], 1),
            (natural["high_frequency"], 2),
        )
    )
    return (
        f"| {run.scene} | {run.map} | {run.label} | {run.turn} | {m['render']['psnr']:.1f} "
        f"({m['initial']['psnr']:.1f}) | {m['envmap']['psnr']:.1f} ({m['initial_envmap']['psnr']:.1f}) | "
        f"{m['halves'][0]:+.1f} / {m['halves'][1]:+.1f} | {off} | "
        f"{100 * natural['colours_outside']:.1f} % | {seam} | {sharp} |"
    )


def summary(rows) -> list[str]:
    """Return means and extremes of every kind of target, with a turn of the sky and without."""
    lines = [
        "| target | turn | runs | rendering, dB (worst) | map over the unedited one, dB (worst) | "
        "worse than unedited | lower half, dB | colours outside (most), over 5 % | seam (most), over 2.5 | "
        "high frequencies, outside 0.7 to 1.3 |\n" + "|---" * 10 + "|"
    ]
    for kind, turn in itertools.product(KINDS, ("auto", "false")):
        some = [m for run, m in rows if run.kind == kind and run.turn == turn]
        if not some:
            continue
        render, gain = [m["render"]["psnr"] for m in some], [m["gain"] for m in some]
        outside = [100 * m["natural"]["colours_outside"] for m in some]
        seam, sharp = (
            [m["natural"][key] for m in some if m["natural"][key] is not None]
            for key in ("seam", "high_frequency")
        )
        lines.append(
            f"| {kind} | {turn} | {len(some)} | {np.mean(render):.1f} ({min(render):.1f}) | "
            f"{np.mean(gain):+.1f} ({min(gain):+.1f}) | {sum(g < 0 for g in gain)} | "
            f"{np.mean([m['halves'][1] for m in some]):+.1f} | "
            f"{np.mean(outside):.1f} % ({max(outside):.1f}), {sum(o > 5 for o in outside)} | "
            f"{np.mean(seam):.1f} ({max(seam):.1f}), {sum(s > 2.5 for s in seam)} | "
            f"{np.mean(sharp):.2f}, {sum(not 0.7 <= s <= 1.3 for s in sharp)} |"
        )
    return lines


def sheet(path: Path, done: list[tuple[Run, Path]]) -> None:
    """Draw a row for each run."""
    rows = []
    for run, folder in done:
        original, true = run.maps()
        shown = [original, true, images.read(str(folder / "edited.exr"))[0]]
        white = 4 * float(np.median(luminance(true)))
        pictures = [images.read(str(folder / f"render_{n}.exr"))[0] for n in ("target", "edited")]
        tiles = [np.clip(m / max(white, 1e-6), 0, 1) ** (1 / 2.2) for m in shown]
        for picture in pictures:
            high = np.zeros((WIDTH // 2, picture.shape[1], 3))
            part = np.clip(picture[: len(high)], 0, 1) ** (1 / 2.2)
            high[: len(part)] = part
            tiles.append(high)
        rows.append(np.pad(np.concatenate(tiles, axis=1), ((0, 3), (0, 0), (0, 0))))
    pixels = (np.concatenate(rows) * 255 + 0.5).astype(np.uint8)
    if path.suffix == ".png":
        path.write_bytes(images.png(pixels))
    else:
        mi.Bitmap(pixels).write(str(path), quality=85)


def main():
    """Compute, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/natural"))
    parser.add_argument("--only", nargs="+", default=[], metavar="TEXT")
    parser.add_argument("--count", type=int)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="table.key=value")
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    out = trials.folder(given.out.absolute(), given.overrides)
    out.mkdir(parents=True, exist_ok=True)
    for e in (ELEVATION, *ELEVATIONS):
        if not (file := out / f"sunsky_{e}.exr").exists():
            images.write_exr(str(file), analytic_sky.sunsky(WIDTH, 90.0, e))
    asked = [r for r in runs(out) if not given.only or any(text in r.name for text in given.only)]
    count = 10 if given.quick else given.count
    asked = asked if count is None else evenly(asked, count)
    rows, done = [], {scene: [] for scene in SCENES}
    for i, run in enumerate(asked):
        folder = out / run.name
        if not (folder / "metrics.json").exists():
            config = out / f"{run.name}.toml"
            config.write_text(run.configuration())
            print(f"{i + 1} of {len(asked)}: {run.name}", flush=True)
            command = [sys.executable, "-m", "envedit.run", str(config), "--out", str(folder), "--quiet"]
            subprocess.run([*command, *(part for o in given.overrides for part in ("--set", o))], check=False)
        if (folder / "metrics.json").exists():
            rows.append((run, measured(run, folder)))
            done[run.scene].append((run, folder))
            rows.sort(key=lambda row: (list(SCENES).index(row[0].scene), row[0].name))
            text = "\n".join([*summary(rows), "", HEAD, *(line(*row) for row in rows)])
            (out / "table.md").write_text(text + "\n")
    print((out / "table.md").read_text() if rows else "nothing was run")
    for scene, some in done.items():
        if some:
            sheet(out / f"{scene}.jpg", sorted(some, key=lambda one: one[0].name))
            print(out / f"{scene}.jpg")


if __name__ == "__main__":
    main()
