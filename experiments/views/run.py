r"""Edit towards a turned map from one view, from another, and from both.

    ENVEDIT_DATA=... python -m experiments.views.run [--out runs/views] [--only TEXT ...] \
        [--set table.key=value ...]

A ball of three materials under four maps, turned by 140 degrees, without a turn of the whole sky. Every run
is ``envedit run`` with its own folder; one that is done (it has metrics.json) is skipped. Writes table.md:
the map against the true one, and the posterior standard deviation of the log gain (mean over the sphere).
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR

from envedit import config
from envedit.core import latlong
from experiments import puresky, trials

HERE = Path(__file__).parent
MATERIALS = {
    "glossy": 'material = "roughplastic", alpha = 0.2',
    "metal": 'material = "roughconductor", alpha = 0.3',
    "rough metal": 'material = "roughconductor", alpha = 0.6',
}
MAPS = "autumn_field", "mud_road", "syferfontein_18d_clear"
SENSORS = {"front": '["front"]', "behind": '["behind"]', "both": '"all"'}
HEAD = "| ball | map | unedited, dB | " + " | ".join(f"map, {name}, dB" for name in SENSORS)
HEAD += " | " + " | ".join(f"deviation, {name}" for name in SENSORS) + " |"


def text(material, source, sensors):
    """Write the configuration of a run."""
    return f"""[input]
envmap = {config.quote(str(source))}
width = 128
[scene]
file = {config.quote(str(HERE / "two.xml"))}
width = 96
sensors = {SENSORS[sensors]}
parameters = {{ {MATERIALS[material]} }}
[target]
rotate_degrees = 140
[representation]
turn = false
"""


def done(folder):
    """Read the map's PSNR before and after, and the deviation."""
    measured = json.loads((folder / "metrics.json").read_text())
    channels = OpenEXR.File(str(folder / "edited_layers.exr"), separate_channels=True).channels()
    deviation = channels["deviation.Y"].pixels
    omega = latlong.solid_angles(*deviation.shape)[:, None] / (4 * np.pi)
    psnr = [measured[name]["psnr"] for name in ("initial_envmap", "envmap")]
    return *psnr, float((deviation * omega).sum())


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/views"))
    parser.add_argument("--only", nargs="*", default=[""])
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    arguments = parser.parse_args()
    out = trials.folder(arguments.out.absolute(), arguments.overrides)
    out.mkdir(parents=True, exist_ok=True)
    maps = {"sunsky": "sunsky"} | {name: path for name, path in puresky.find().items() if name in MAPS}
    lines, gains = [HEAD, "|" + "---|" * (HEAD.count("|") - 1)], []
    for material in MATERIALS:
        for name, source in maps.items():
            found = []
            for sensors in SENSORS:
                folder = out / f"{material}-{name}-{sensors}".replace(" ", "-")
                if not any(part in folder.name for part in arguments.only):
                    continue
                if not (folder / "metrics.json").exists():
                    file = folder.with_suffix(".toml")
                    file.write_text(text(material, source, sensors))
                    extra = [part for pair in arguments.overrides for part in ("--set", pair)]
                    command = [
                        sys.executable,
                        "-m",
                        "envedit",
                        "run",
                        str(file),
                        "--out",
                        str(folder),
                        "--quiet",
                    ]
                    subprocess.run([*command, *extra], check=True)
                found.append(done(folder))
            if len(found) == len(SENSORS):
                cells = [
                    f"{found[0][0]:.1f}",
                    *(f"{f[1]:.1f}" for f in found),
                    *(f"{f[2]:.3f}" for f in found),
                ]
                lines.append(f"| {material} | {name} | {' | '.join(cells)} |")
                gains.append([found[2][i] - np.mean([f[i] for f in found[:2]]) for i in (1, 2)])
    if gains:
        better, less = np.transpose(gains)
        lines.append(
            f"\nBoth views against the mean of one: map {better.mean():+.1f} dB (median "
            f"{np.median(better):+.1f}, worst {better.min():+.1f}), deviation {less.mean():+.3f} "
            f"(worst {less.max():+.3f}); {len(gains)} cases."
        )
    (out / "table.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
