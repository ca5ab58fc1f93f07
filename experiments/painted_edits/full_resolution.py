"""Carry an edit to an 8k map: seconds, memory, and light against the working map, in rendered pixels.

The map is a real one enlarged, with procedural detail, so that it has something to keep. The edit turns it by
40 degrees. Measured is what the program does after an edit: reading the file, carrying, writing.
"""

import resource
import time

import numpy as np

from envedit import config, inputs, pipeline
from envedit.core import latlong
from envedit.export import full_resolution
from envedit.images import images, layered_exr
from envedit.losses import metrics
from experiments import puresky
from experiments.harness import Experiment, calling

WIDTH = 8192
KINDS = "layers", "log-pixels"


def large(file: str, width: int) -> np.ndarray:
    """Enlarge a map, with 10 % of fine detail."""
    base = latlong.resize(images.load_envmap(file)[0], width // 2, width)
    row, column = np.mgrid[: width // 2, :width].astype(np.float32)
    for k, (a, b) in enumerate(((0.9, 0.35), (0.21, 0.57), (1.7, 1.3))):
        base *= (1 + 0.05 * np.sin(a * row + b * column + k))[..., None].astype(np.float32)
    return base


def gigabytes() -> float:
    """Return the most memory that this process has occupied."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def carry(settings, folder) -> dict:
    """Make the large map, edit, carry, compare; returns seconds, gigabytes, shares of light and texels."""
    file = folder / "large.exr"
    layered_exr.write(file, {"edited": large(settings.input.envmap, WIDTH)})
    result = pipeline.run(config.load(folder / "job.toml", overrides=[f"input.envmap={file.name}"]))
    before, times = gigabytes(), [time.perf_counter()]
    source, _ = images.load_envmap(str(file))
    times.append(time.perf_counter())
    found, rows = result.found, inputs.active_rows(settings.input.rows, result.envmap.shape[0])
    original, edited = result.maps["initial"], result.envmap
    full = full_resolution.carry(
        found.representation, found.params, original, edited, source, rows, found.free
    )
    times.append(time.perf_counter())
    layered_exr.write(file, {"edited": full})
    times.append(time.perf_counter())
    after = gigabytes()
    file.unlink()
    read, carried, written = (float(seconds) for seconds in np.diff(times))
    lit = inputs.load_scene(settings.scene)
    a, b = (lit.render(m, spp=1024, seed=s) for m, s in ((edited, 1), (full, 2)))
    coarse = [p.reshape(16, 8, 16, 8, 3).mean(axis=(1, 3)) for p in (a, b)]
    return {
        "seconds": [read, carried, written],
        "gigabytes": [before, after],
        "same": 100 * float((full == source).all(axis=2).mean()),
        "light": 100 * float(np.abs(b.mean(axis=(0, 1)) / a.mean(axis=(0, 1)) - 1).max()),
        "blocks": 100 * float(np.abs(coarse[1] / coarse[0] - 1).max()),
        "psnr": metrics.compare(b, a)["psnr"],
    }


def cases(given):
    name = "kloofendal_48d_partly_cloudy"
    tables = {
        "input": {"envmap": puresky.file(name)},
        "scene": {"file": "sphere", "width": 128},
        "target": {"rotate_degrees": 40.0},
    }
    function = "experiments.painted_edits.full_resolution:carry"
    return [
        calling(kind, function, tables | {"representation": {"kind": kind, "turn": False}}, {"kind": kind})
        for kind in KINDS
    ]


EXPERIMENT = Experiment(
    "painted_edits.full_resolution",
    "Carry an edit to an 8k map: seconds, memory, and light against the working map.",
    cases,
    columns={
        "representation": "{kind}",
        "read, carry, write, s": "{seconds[0]:.1f}, {seconds[1]:.1f}, {seconds[2]:.1f}",
        "memory before and after, GB": "{gigabytes[0]:.2f}, {gigabytes[1]:.2f}",
        "texels with the source's bits": "{same:.1f} %",
        "light apart": "{light:.2f} %",
        "blocks of 8x8 pixels, at most": "{blocks:.1f} %",
        "rendering against the working map's, dB": "{psnr:.1f}",
    },
    alone=True,
)
