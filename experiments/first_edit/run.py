r"""Turn real maps by 60 degrees, three representations, one scene: compute what is missing, print a table.

    ENVEDIT_DATA=... python -m experiments.first_edit.run \
        [--out runs/first_edit] [--maps NAME ...] [--set table.key=value ...]

Every run is ``python -m envedit.run`` with its own folder; one that is done (it has metrics.json) is skipped.
Runs under ``--set`` lie in a folder of their own.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from experiments import puresky, trials

MAPS = ("kloofendal_48d_partly_cloudy", "autumn_field", "wasteland_clouds", "overcast_soil")
KINDS = ("siren", "pixels", "log-pixels")
NAMES = {"siren": "R-SIREN", "pixels": "Pixels", "log-pixels": "Log(pixels)"}


def jobs(out: Path, maps: dict[str, Path], overrides):
    """Yield (map, representation, folder, command line) of every run."""
    for name, file in maps.items():
        for kind in KINDS:
            folder = out / f"{name}-{kind}"
            text = (
                f'[input]\nenvmap = "{file}"\nwidth = 256\nrows = "upper"\n'
                f'[scene]\nfile = "sphere"\nparameters = {{ roughness = 0.3 }}\n'
                f"[target]\nrotate_degrees = 60.0\nspp = 2048\n[output]\nspp = 2048\n"
                f'[representation]\nkind = "{kind}"\nturn = false\n'
            )
            yield name, kind, folder, text, [part for o in overrides for part in ("--set", o)]


def table(out: Path, maps) -> str:
    """Return the results as a Markdown table; a run that is missing has dashes."""
    lines = [
        "| map | representation | rendering PSNR (unedited) | SSIM | map PSNR (unedited) | SSIM | "
        "sun off, texels | fit s | edit s | total s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    means = {}
    for name in maps:
        for kind in KINDS:
            path = out / f"{name}-{kind}" / "metrics.json"
            if not path.exists():
                lines.append(f"| {name} | {NAMES[kind]} | - | - | - | - | - | - | - | - |")
                continue
            m = json.loads(path.read_text())
            means.setdefault(kind, []).append(
                (m["render"]["psnr"], m["render"]["ssim"], m["envmap"]["psnr"], m["envmap"]["ssim"])
            )
            t = m["timing"]
            fit = "kept" if m["fit"] and m["fit"]["cached"] else f"{t['fit_s']:.0f}"
            render, before = m["render"], m["initial"]
            found, known = m["envmap"], m["initial_envmap"]
            lines.append(
                f"| {name} | {NAMES[kind]} | {render['psnr']:.2f} ({before['psnr']:.2f}) | "
                f"{render['ssim']:.3f} | {found['psnr']:.2f} ({known['psnr']:.2f}) | {found['ssim']:.3f} | "
                f"{m['sun_offset_texels']:.1f} | {fit} | {t['edit_s']:.0f} | {t['total_s']:.0f} |"
            )
    for kind, rows in means.items():
        a, b, c, d = (sum(column) / len(rows) for column in zip(*rows, strict=True))
        lines.append(
            f"| **mean of {len(rows)}** | {NAMES[kind]} | {a:.2f} | {b:.3f} | {c:.2f} | {d:.3f} | | | | |"
        )
    return "\n".join(lines)


def main():
    """Compute and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/first_edit"))
    parser.add_argument("--maps", nargs="+", default=MAPS)
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    arguments = parser.parse_args()
    maps = puresky.of_script(arguments.maps)
    out = trials.folder(arguments.out.absolute(), arguments.overrides)
    out.mkdir(parents=True, exist_ok=True)
    for name, kind, folder, text, overrides in jobs(out, maps, arguments.overrides):
        if (folder / "metrics.json").exists():
            continue
        config = out / f"{name}-{kind}.toml"
        config.write_text(text)
        print(f"{name}, {NAMES[kind]}", flush=True)
        subprocess.run(
            [sys.executable, "-m", "envedit.run", str(config), "--out", str(folder), *overrides], check=False
        )
    text = table(out, maps)
    (out / "table.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
