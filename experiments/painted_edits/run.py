r"""Carry out the six edits of scenes/edits on the analytic sky and on real maps: a table of all of it.

    ENVEDIT_DATA=... python -m experiments.painted_edits.run [--out runs/painted] [--edits NAME ...] \
        [--maps sunsky kloofendal_48d_partly_cloudy sunflowers] [--set table.key=value ...]
    ENVEDIT_DATA=... python -m experiments.painted_edits.run --ablation      # Figure 9: regularisers

Every run is ``python -m envedit.run`` with its own folder; one that is done (it has metrics.json) is skipped.
The two real maps have their sun where the strokes expect one; without ENVEDIT_DATA only the analytic sky is
used. ``python -m experiments.painted_edits.sheet`` draws the contact sheet.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import mitsuba as mi

from envedit.core.errors import EnveditError
from envedit.images import images
from envedit.losses import metrics
from experiments import puresky, trials

ROOT = Path(__file__).parents[2]
EDITS = ("move_shadow", "add_reflection", "add_shadow", "warmer", "enhance_shadow", "blur_shadow")
MAPS = ("sunsky", "kloofendal_48d_partly_cloudy", "sunflowers")
ABLATION = {
    "no regulariser": ["loss.change=0"],
    "change 0.01": [],
    "luminance + L1": ["loss.change=0", "loss.luminance=[1e-5, 1e-9]", "loss.l1=[1e-5, 1e-9]"],
    "change 0.1": ["loss.change=0.1"],
}
"""What the ablation sets."""


def file_of(name: str) -> str | None:
    """Return what [input] envmap is for a map, None where the data are not there."""
    if name == "sunsky":
        return name
    try:
        file = puresky.find().get(name)
    except EnveditError:
        return None
    return str(file) if file else None


def carry_out(folder: Path, edit: str, envmap: str, overrides) -> dict | None:
    """Run one edit unless that is done, and return what the table shows of it."""
    if not (folder / "metrics.json").exists():
        sets = [f"input.envmap={envmap}", *overrides]
        command = [sys.executable, "-m", "envedit.run", str(ROOT / "scenes/edits" / f"{edit}.toml")]
        command += ["--out", str(folder), "--quiet", *(part for o in sets for part in ("--set", o))]
        print(folder.name, flush=True)
        subprocess.run(command, check=False)
    if not (folder / "metrics.json").exists():
        return None
    found = json.loads((folder / "metrics.json").read_text())
    first, last = found["active_rows"]
    rows = slice(first, last + 1)
    edited, original = layers(folder)
    sharp = [metrics.high_frequency_energy(m[rows]) for m in (edited, original)]
    return {
        **found["painted"],
        "ssim": metrics.compare(edited[rows], original[rows])["ssim"],
        "sharp": sharp[0] / sharp[1],
        "seconds": found["timing"]["total_s"],
    }


def layers(folder: Path):
    """Return the edited map and the original of a run."""
    import OpenEXR

    channels = OpenEXR.File(str(folder / "edited_layers.exr"), separate_channels=True).channels()
    edited = images.read(str(folder / "edited.exr"))[0]
    original = edited.copy()
    for i, channel in enumerate("RGB"):
        original[..., i] = channels[f"initial.{channel}"].pixels
    return edited, original


HEAD = (
    "| edit | map | towards the paint | reachable | share of it | change elsewhere | map SSIM | "
    "high frequencies | s |\n" + "|---" * 9 + "|"
)


def line(edit, name, m) -> str:
    """One row of the table."""
    share = m["towards"] / m["reachable"] if m["reachable"] else float("nan")
    elsewhere = "-" if m["elsewhere"] is None else f"{m['elsewhere']:.4f}"
    return (
        f"| {edit} | {name} | {100 * m['towards']:.0f} % | {100 * m['reachable']:.0f} % "
        f"| {100 * share:.0f} % | {elsewhere} | {m['ssim']:.3f} | {m['sharp']:.2f} | {m['seconds']:.0f} |"
    )


def main():
    """Compute and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/painted"))
    parser.add_argument("--edits", nargs="+", default=list(EDITS), choices=EDITS)
    parser.add_argument("--maps", nargs="+", default=list(MAPS))
    parser.add_argument("--ablation", action="store_true", help="regularisers on the analytic sky")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="table.key=value")
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    out = trials.folder(given.out.absolute(), given.overrides)
    out.mkdir(parents=True, exist_ok=True)
    lines = [HEAD]
    kinds = ABLATION if given.ablation else {"": []}
    for kind, sets in kinds.items():
        for edit in given.edits:
            for name in given.maps[:1] if given.ablation else given.maps:
                if not (envmap := file_of(name)):
                    print(f"{name}: skipped, ENVEDIT_DATA has no puresky/{name}_puresky_1k.hdr")
                    continue
                label = "-".join(part.replace(" ", "_") for part in (edit, name, kind) if part)
                if m := carry_out(out / label, edit, envmap, [*sets, *given.overrides]):
                    lines.append(line(f"{edit}, {kind}" if kind else edit, name, m))
    text = "\n".join(lines)
    (out / ("ablation.md" if given.ablation else "table.md")).write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
