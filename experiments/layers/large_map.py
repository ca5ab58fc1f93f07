r"""Look at an edit at 8192x4096 in crops: where the sun was, where it went, the horizon, the disc.

    ENVEDIT_DATA=... python -m experiments.layers.large_map [--map NAME] [--turned 75]      # two minutes

The maps at hand are 1024 wide: one is enlarged eightfold, with fractal detail above the horizon and its sun
drawn as a disc of 0.53 degrees of the same flux. The statue is edited towards the map turned, while the sky
may not turn, so that the sun must move. Printed is what could betray the edit.
"""

import argparse
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np

import envedit
from envedit.core import latlong
from envedit.images import images
from experiments import puresky

WIDTH, HEIGHT = 8192, 4096
RADIUS = 0.2665
"""Of the sun, degrees."""
GRAIN = 0.05
"""Standard deviation of log radiance in the first octave of detail; each further one has 0.57 of it."""
AROUND, CORE = 500, 24
"""Half the size of the crops, texels."""
PLACES = "where the sun was", "where it went", "horizon below it", "horizon where it went"


def enlarged(small: np.ndarray) -> np.ndarray:
    """Return a map (4096, 8192, 3) with the detail of a large photograph, and the flux of the small one."""
    height, width, _ = small.shape
    light = small.mean(axis=2)
    row, column = np.unravel_index(light.argmax(), light.shape)
    sun = light > max(50 * np.median(light), 0.05 * light.max())
    omega = latlong.solid_angles(height, width)[:, None, None]
    flux = (small * sun[..., None] * omega).sum(axis=(0, 1))
    sky = small.copy()
    shifts = [np.roll(sun, step, axis) for axis in (0, 1) for step in (-3, 3)]
    sky[sun] = np.median(small[np.any(shifts, axis=0) & ~sun], axis=0)
    log = _resized(np.log(sky + 1e-4))
    rng = np.random.default_rng(0)
    for octave in range(4):
        size = HEIGHT >> (3 - octave), WIDTH >> (3 - octave)
        noise = rng.normal(0, GRAIN * 0.57**octave, size).astype(np.float32)
        log[: HEIGHT // 2] += _resized(np.repeat(noise[..., None], 3, 2))[: HEIGHT // 2]
    large = np.maximum(np.exp(log) - 1e-4, 0)
    there = latlong.directions(height, width)[row, column]
    disc = latlong.directions(HEIGHT, WIDTH) @ there > np.cos(np.radians(RADIUS))
    omega = np.broadcast_to(latlong.solid_angles(HEIGHT, WIDTH)[:, None], disc.shape)
    large[disc] += (flux / omega[disc].sum()).astype(np.float32)
    return large


def _resized(image):
    return np.array(mi.Bitmap(np.ascontiguousarray(image, np.float32)).resample([WIDTH, HEIGHT]))


def crop(envmap: np.ndarray, row: int, column: int, around: int) -> np.ndarray:
    """Return the texels around one, across the seam too."""
    rows = np.clip(np.arange(row - around, row + around), 0, HEIGHT - 1)
    return envmap[rows][:, np.arange(column - around, column + around) % WIDTH]


def _shown(*both):
    """Show crops beside each other, with one exposure and a curve that nothing is too bright for."""
    middle = np.median(both)
    return np.concatenate([np.uint8(255 * (one / (one + middle)) ** (1 / 2.2)) for one in both], axis=1)


def main(argv=None):
    """Edit, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--map", default="syferfontein_18d_clear", help="of a sun (%(default)s)")
    parser.add_argument("--turned", type=float, default=75.0, metavar="DEGREES", help="the target's map (75)")
    parser.add_argument("--to", type=Path, default=Path("experiments/layers"), help="of large_map.jpg")
    given = parser.parse_args(argv)
    mi.set_variant("llvm_ad_rgb")
    source = enlarged(images.load_envmap(str(puresky.of_script([given.map])[given.map]), 1024)[0])
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "large.exr"
        images.write_exr(file, source)
        out = Path(folder) / "out"
        settings = {
            "input": {"envmap": str(file)},
            "scene": {"file": "statue"},
            "target": {"rotate_degrees": given.turned},
            "representation": {"turn": False},
        }
        result = envedit.edit(settings)
        result.save(out)
        edited, _ = images.load_envmap(str(out / "edited_full.exr"), WIDTH)
    old, new = (np.unravel_index(one.mean(axis=2).argmax(), one.shape[:2]) for one in (source, edited))
    rendering, whole = (result.metrics[of]["psnr"] for of in ("render", "envmap"))
    print(f"rendering {rendering:.1f} dB, map {whole:.1f} dB")
    print(f"sun moved by {(old[1] - new[1]) % WIDTH / WIDTH * 360:.2f} degrees about the vertical")
    omega = latlong.solid_angles(HEIGHT, WIDTH)[:, None]
    for name, one, (row, column) in (("source", source, old), ("edited", edited, new)):
        disc = crop(one.mean(axis=2), row, column, CORE)
        flux = (disc * omega[row - CORE : row + CORE]).sum()
        texels = (disc > disc.max() / 2).sum()
        print(f"{name}: disc of {texels} texels, peak {disc.max():.4g}, flux {flux:.4g}")
    rows = slice(HEIGHT // 2 - 1, HEIGHT // 2 + 1)
    change = np.log2((edited[rows] + 1e-4) / (source[rows] + 1e-4)).mean(axis=2)
    middle, most = np.percentile(np.abs(change[1] - change[0]), [50, 99.9])
    print(f"step of the change across the horizon: median {middle:.4f}, 99.9 % {most:.4f} stops")
    crops = [
        _shown(*(crop(one, *place, AROUND)[::2, ::2] for one in (source, edited)))
        for place in (old, new, (HEIGHT // 2, old[1]), (HEIGHT // 2, new[1]))
    ]
    picture = np.concatenate([np.concatenate(crops[k : k + 2], axis=1) for k in (0, 2)])
    mi.Bitmap(picture).write(str(given.to / "large_map.jpg"), quality=88)
    print(f"{given.to / 'large_map.jpg'}, original and edited: {', '.join(PLACES)}")


if __name__ == "__main__":
    main()
