"""A look on maps that it was not made on: all PureSky maps in the light of one edit, ``evening.toml``.

The key light is measured as stars are, by aperture photometry, and not by the separation that the look is
applied with.
"""

import time
from pathlib import Path

import numpy as np

from envedit.core import latlong
from envedit.core.color import LUMINANCE, tonemap
from envedit.images import images
from envedit.maps import look_transfer, looks, map_file
from envedit.scene import scene
from experiments import puresky
from experiments.harness import Done, Experiment
from experiments.measures import degrees

LOOK = Path(__file__).parent / "evening.toml"
WIDTH = 256
APERTURE, RING = 6.0, 8.0
"""Degrees around the key light that hold its flux, and up to which a ring has the sky's radiance there."""


def cases(given):
    return puresky.cases(in_its_light, {"scene": {"file": "sphere"}}, look=LOOK.read_text())


def in_its_light(settings, folder: Path, file: str, look: str) -> dict:
    """Apply the look to a map, and measure and render it before and after."""
    path = folder / "look.toml"
    path.write_text(look)
    evening = looks.read(path)
    before = map_file.read(file).radiance
    start = time.perf_counter()
    after = look_transfer.apply(before, evening)
    seconds = time.perf_counter() - start

    sphere = scene.load(settings.scene.file, width=128, parameters={"roughness": 0.3})
    for name, envmap in (("before", before), ("after", after)):
        small = latlong.resize(envmap, WIDTH // 2, WIDTH)
        images.write_exr(folder / f"{name}.exr", small)
        images.write_exr(folder / f"render_{name}.exr", sphere.render(small, spp=256), panorama=False)
    own = looks.lights_of(looks.layers_of(latlong.resize(before, WIDTH // 2, WIDTH))).get("key")
    stops, degrees = photometry(small, evening.toward("key"))
    asked = evening.lights["key"].flux
    return {
        "asked": asked,
        "before": None if own is None else own.flux,
        "after": stops,
        "degrees": degrees,
        "seconds": seconds,
    }


def photometry(envmap: np.ndarray, toward: np.ndarray) -> tuple[float, float]:
    """Measure the key light of a map (H, W, 3) that should be at the direction ``toward`` (3,).

    Returns its flux over the horizontal irradiance of the rest, stops, and how far its centroid is from
    there, degrees.
    """
    height, width, _ = envmap.shape
    d = latlong.directions(height, width)
    omega = latlong.lookup_solid_angles(height, width)[:, None]
    apart = degrees(d, toward)
    light = envmap.astype(np.float64) @ LUMINANCE
    inside = apart < APERTURE
    around = np.median(light[(apart >= APERTURE) & (apart < RING)])
    flux = np.where(inside, np.maximum(light - around, 0), 0) * omega
    sky = np.where(inside, np.minimum(light, around), light) * omega * np.maximum(d[..., 1], 0)
    centre = (flux[..., None] * d).sum(axis=(0, 1))
    centre /= np.linalg.norm(centre)
    return float(np.log2(flux.sum() / sky.sum())), float(degrees(centre, toward))


def panels(done: Done) -> list[np.ndarray]:
    """Return the map and the sphere under it, before and after, each exposed for itself."""
    shown = []
    for name in ("before", "after"):
        envmap, picture = done.picture(name), done.picture(f"render_{name}")
        sky = np.median(envmap[: len(envmap) // 2].mean(axis=2))
        bright = np.quantile(picture.mean(axis=2), 0.9)
        shown += [tonemap(0.15 / sky * envmap, "gamma"), tonemap(0.6 / bright * picture, "gamma")]
    return shown


EXPERIMENT = Experiment(
    cases,
    columns={
        "map": "{map}",
        "key light before, stops": "{before:.2f}",
        "of the look": "{asked:.2f}",
        "after": "{after:.2f}",
        "direction off, degrees": "{degrees:.1f}",
        "seconds": "{seconds:.1f}",
    },
    panels=panels,
)
