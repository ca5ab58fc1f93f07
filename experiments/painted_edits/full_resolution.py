r"""Carry an edit to an 8k map: seconds, memory, and light against the working map, in rendered pixels.

    ENVEDIT_DATA=... python -m experiments.painted_edits.full_resolution [--width 8192] [--kind layers] \
        [--map kloofendal_48d_partly_cloudy] [--out runs/full]

The map is a real one enlarged, with procedural detail, so that it has something to keep. The edit turns it by
40 degrees. Measured is what the program does after an edit: reading the file, carrying, writing.
"""

import argparse
import resource
import time
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit import config, inputs, pipeline
from envedit.core import latlong
from envedit.export import full_resolution
from envedit.images import images, layered_exr
from envedit.losses import metrics
from envedit.scene import scene

from .experiment import file_of


def large(file: str, width: int) -> np.ndarray:
    """Enlarge a map, with 10 % of fine detail."""
    base = latlong.resize(images.load_envmap(file)[0], width // 2, width)
    row, column = np.mgrid[: width // 2, :width].astype(np.float32)
    for k, (a, b) in enumerate(((0.9, 0.35), (0.21, 0.57), (1.7, 1.3))):
        base *= (1 + 0.05 * np.sin(a * row + b * column + k))[..., None].astype(np.float32)
    return base


def main():
    """Make, edit, carry, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=8192)
    parser.add_argument("--kind", default="layers")
    parser.add_argument("--map", default="kloofendal_48d_partly_cloudy")
    parser.add_argument("--out", type=Path, default=Path("runs/full"))
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    given.out.mkdir(parents=True, exist_ok=True)
    file = given.out / f"{given.map}_{given.width}.exr"
    if not file.exists():
        if not (small := file_of(given.map)):
            parser.error("ENVEDIT_DATA has no such map")
        layered_exr.write(file, {"edited": large(small, given.width)})
        print(f"{file} made; run again, so that its making does not count")
        return
    settings = config.from_dict(
        {
            "input": {"envmap": str(file.absolute())},
            "scene": {"file": "sphere"},
            "target": {"rotate_degrees": 40.0},
            "representation": {"kind": given.kind},
        }
    )
    result = pipeline.run(settings)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    start = time.perf_counter()
    source, _ = images.load_envmap(str(file))
    read = time.perf_counter() - start
    found, rows = result.found, inputs.active_rows(settings.input.rows, result.envmap.shape[0])
    original, edited = result.maps["initial"], result.envmap
    start = time.perf_counter()
    full = full_resolution.carry(
        found.representation, found.params, original, edited, source, rows, found.free
    )
    carried = time.perf_counter() - start
    start = time.perf_counter()
    layered_exr.write(given.out / "edited_full.exr", {"edited": full})
    written = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"{given.width} x {given.width // 2}, {given.kind}: "
        f"read {read:.1f} s, carry {carried:.1f} s, write {written:.1f} s"
    )
    print(f"memory: {before:.2f} GB at most before, {peak:.2f} GB after")
    same = (full == source).all(axis=2)
    print(f"texels with the bits of the source: {100 * same.mean():.1f} %")
    lit = scene.load("sphere", 128)
    a, b = (lit.render(m, spp=1024, seed=s) for m, s in ((edited, 1), (full, 2)))
    light = np.abs(b.mean(axis=(0, 1)) / a.mean(axis=(0, 1)) - 1).max()
    coarse = [p.reshape(16, 8, 16, 8, 3).mean(axis=(1, 3)) for p in (a, b)]
    worst = np.abs(coarse[1] / coarse[0] - 1).max()
    print(
        f"rendered: light {100 * light:.2f} % apart, blocks of 8x8 pixels at most {100 * worst:.1f} %, "
        f"{metrics.compare(b, a)['psnr']:.1f} dB"
    )


if __name__ == "__main__":
    main()
