"""Look at an edit at 8192x4096 in crops: where the sun was, where it went, the horizon, the disc.

The maps at hand are 1024 wide: one is enlarged eightfold, with fractal detail above the horizon and its sun
drawn as a disc of 0.53 degrees of the same flux. The statue is edited towards the map turned, while the sky
may not turn, so that the sun must move. Measured is what could betray the edit.
"""

import shutil

import mitsuba as mi
import numpy as np

from envedit import config, pipeline
from envedit.core import latlong
from envedit.images import images
from experiments import puresky
from experiments.harness import Experiment, calling

WIDTH, HEIGHT = 8192, 4096
RADIUS = 0.2665
"""Of the sun, degrees."""
GRAIN = 0.05
"""Standard deviation of log radiance in the first octave of detail; each further one has 0.57 of it."""
AROUND, CORE = 500, 24
"""Half the size of the crops, texels."""


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


def shown(*both) -> np.ndarray:
    """Show crops beside each other, with one exposure and a curve that nothing is too bright for."""
    middle = np.median(both)
    return np.concatenate([(one / (one + middle)) ** (1 / 2.2) for one in both], axis=1)


def look(settings, folder) -> dict:
    """Enlarge a map, edit it, and measure the disc of the sun and the step across the horizon.

    ``crops.exr``, display values, original and edited beside each other: where the sun was, where it went;
    the horizon below both.
    """
    source = enlarged(images.load_envmap(settings.input.envmap, 1024)[0])
    images.write_exr(folder / "large.exr", source)
    given = ["input.envmap=large.exr"]
    result = pipeline.run(config.load(folder / "job.toml", overrides=given))
    result.save(folder / "out")
    edited, _ = images.load_envmap(str(folder / "out" / "edited_full.exr"), WIDTH)
    old, new = (np.unravel_index(one.mean(axis=2).argmax(), one.shape[:2]) for one in (source, edited))
    omega, found = latlong.solid_angles(HEIGHT, WIDTH)[:, None], {}
    for name, one, (row, column) in (("source", source, old), ("edited", edited, new)):
        disc = crop(one.mean(axis=2), row, column, CORE)
        flux = (disc * omega[row - CORE : row + CORE]).sum()
        found[name] = [int((disc > disc.max() / 2).sum()), float(disc.max()), float(flux)]
    rows = slice(HEIGHT // 2 - 1, HEIGHT // 2 + 1)
    change = np.log2((edited[rows] + 1e-4) / (source[rows] + 1e-4)).mean(axis=2)
    crops = [
        shown(*(crop(one, *place, AROUND)[::2, ::2] for one in (source, edited)))
        for place in (old, new, (HEIGHT // 2, old[1]), (HEIGHT // 2, new[1]))
    ]
    picture = np.concatenate([np.concatenate(crops[k : k + 2], axis=1) for k in (0, 2)])
    images.write_exr(folder / "crops.exr", picture.astype(np.float32))
    (folder / "large.exr").unlink()
    shutil.rmtree(folder / "out")
    return found | {
        "render": result.metrics["render"]["psnr"],
        "map": result.metrics["envmap"]["psnr"],
        "degrees": float((old[1] - new[1]) % WIDTH / WIDTH * 360),
        "step": [float(value) for value in np.percentile(np.abs(change[1] - change[0]), [50, 99.9])],
    }


def cases(given):
    name = "syferfontein_18d_clear"
    tables = {
        "input": {"envmap": puresky.file(name)},
        "scene": {"file": "statue"},
        "target": {"rotate_degrees": 75},
        "representation": {"turn": False},
    }
    return [calling(name, "experiments.layers.large_map:look", tables)]


EXPERIMENT = Experiment(
    "layers.large_map",
    "Look at an edit at 8192x4096 in crops: where the sun was, where it went, the horizon, the disc.",
    cases,
    columns={
        "rendering, dB": "{render:.1f}",
        "map, dB": "{map:.1f}",
        "sun moved, degrees": "{degrees:.2f}",
        "disc before: texels, peak, flux": "{source[0]}, {source[1]:.4g}, {source[2]:.4g}",
        "disc after": "{edited[0]}, {edited[1]:.4g}, {edited[2]:.4g}",
        "step across the horizon, stops: median, 99.9 %": "{step[0]:.4f}, {step[1]:.4f}",
    },
    panels=lambda done: [done.picture("crops")],
    sheet=lambda case: "large_map.jpg",
)
