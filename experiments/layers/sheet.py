r"""Draw contact sheets of what ``experiments.layers.run`` has computed: a row a map.

    python -m experiments.layers.sheet [--out runs/layers] [--to experiments/layers]

Columns: original, true map, edited map of each kind, target, edited rendering of each kind.
"""

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.color import tonemap
from envedit.images import images
from experiments import puresky

from .run import NAMES, SCENES


def row(out: Path, name, file, scene, angle, kinds):
    """Pictures of one map, or None where nothing has been computed."""
    folders = {kind: out / f"{name}-{scene}-{angle}-{kind}" for kind in kinds}
    done = {kind: folder for kind, folder in folders.items() if (folder / "metrics.json").exists()}
    if not done:
        return None
    original, _ = images.load_envmap(str(file), 256)
    half = original.shape[0] // 2
    skies = [original, latlong.rotate(original, angle)]
    skies += [images.read(str(done[k] / "edited.exr"))[0] if k in done else 0 * original for k in kinds]
    first = next(iter(done.values()))
    pictures = [images.read(str(first / "render_target.exr"))[0]]
    pictures += [
        images.read(str(done[k] / "render_edited.exr"))[0] if k in done else 0 * pictures[0] for k in kinds
    ]
    step = pictures[0].shape[0] // half
    tiles = [s[:half] for s in skies]
    tiles += [p[: half * step].reshape(half, step, -1, step, 3).mean(axis=(1, 3)) for p in pictures]
    return np.concatenate([np.pad(tonemap(t, "gamma"), ((0, 2), (0, 2), (0, 0))) for t in tiles], axis=1)


def main():
    """Draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/layers"))
    parser.add_argument("--to", type=Path, default=Path("experiments/layers"))
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    for scene in SCENES:
        for angle in (60, 140):
            kinds = [k for k in NAMES if any(given.out.glob(f"*-{scene}-{angle}-{k}/metrics.json"))]
            rows = [row(given.out, n, f, scene, angle, kinds) for n, f in puresky.of_script().items()]
            rows = [r for r in rows if r is not None]
            if rows:
                pixels = (np.concatenate(rows) * 255 + 0.5).astype(np.uint8)
                path = given.to / f"{scene}_{angle}.png"
                path.write_bytes(images.png(pixels))
                print(path)


if __name__ == "__main__":
    main()
