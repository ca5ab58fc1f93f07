r"""Draw contact sheets of what ``experiments.painted_edits.run`` has computed: a row an edit.

    python -m experiments.painted_edits.sheet [--out runs/painted] [--to experiments/painted_edits]

Columns: initial rendering, painted, edited rendering, what no light can do; original map, edited map.
"""

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit.core.color import tonemap
from envedit.images import images

from .run import EDITS, MAPS, layers


def row(folder: Path):
    """Pictures of one edit, display values."""
    renders = [images.read(str(folder / f"render_{n}.exr"))[0] for n in ("initial", "target", "edited")]
    shown = [tonemap(picture, "gamma") for picture in renders]
    unreachable, _ = images.read_stored(str(folder / "unreachable.png"))
    shown.append(unreachable[..., :3] / 255)
    edited, original = layers(folder)
    half = original.shape[0] // 2
    scale = shown[0].shape[0] // half
    maps = [np.kron(tonemap(m[:half], "gamma"), np.ones((scale, scale, 1))) for m in (original, edited)]
    return np.concatenate([np.pad(p, ((0, 3), (0, 3), (0, 0))) for p in [*shown, *maps]], axis=1)


def main():
    """Draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/painted"))
    parser.add_argument("--to", type=Path, default=Path("experiments/painted_edits"))
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    for name in MAPS:
        folders = [given.out / f"{edit}-{name}" for edit in EDITS]
        rows = [row(folder) for folder in folders if (folder / "metrics.json").exists()]
        if rows:
            pixels = (np.clip(np.concatenate(rows), 0, 1) * 255 + 0.5).astype(np.uint8)
            path = given.to / f"{name}.png"
            path.write_bytes(images.png(pixels))
            print(path)


if __name__ == "__main__":
    main()
