"""Clip maps at four levels and as 8-bit pictures, give their sun back, and compare with the truth."""

import numpy as np

from envedit.core.color import luminance, tonemap
from envedit.images import images
from envedit.representations.layers import clipped_light, unclip
from experiments import puresky
from experiments.harness import Experiment, calling
from experiments.measures import degrees
from experiments.summary import Summary
from experiments.unclip import clipping

GROUPS = ("used for choices", "kept out of all choices", "rooms, low sun, night")
SHOWN = ("100", "8 bit")
"""Clippings of the sheet."""


def stops(value: float, true: float) -> float:
    """Return log2 of a ratio; NaN where either is 0."""
    return float(np.log2(value / true)) if value > 0 and true > 0 else float("nan")


def measure_map(settings, folder, file: str, map_name: str) -> list[dict]:
    """Return a row for every clipping of a map, and write the pictures of the sheet."""
    radiance = clipping.load(file)
    true = clipping.truth(radiance)
    sunny = true.sunny and map_name not in clipping.ROOMS
    shadow = clipping.Shadow(true.direction)
    picture = shadow.render(radiance)
    rows = []
    for level in clipping.LEVELS:
        image, exposure = clipping.clipped(radiance, level)
        light = clipped_light.find(image)
        result = image
        flux = 0.0 if light is None else light.core_flux
        added = False
        spread = float("nan")
        if light is not None and light.kind == "sun":
            estimate = unclip.estimate(light)
            spread = estimate.stops
            added = unclip.is_clipped(light, estimate.flux)
            if added:
                flux = float(luminance(estimate.flux))
                result = unclip.restored(image, light, estimate.flux)
        pictures = [shadow.render(one / np.float32(exposure)) for one in (image, result)]
        off = degrees(light.direction, true.direction) if light else float("nan")
        rows.append(
            {
                "level": level,
                "sunny": sunny,
                "kind": light.kind if light else "nothing",
                "added": added,
                "spread": spread,
                "false": added
                and not sunny
                and flux > clipping.SUNNY * float(luminance(light.sky_irradiance)),
                "off": float(off),
                "true_ratio": stops(true.flux, true.sky),
                "clipped_flux": stops(light.core_flux / exposure if light else 0.0, true.flux),
                "flux": stops(flux / exposure, true.flux),
                "clipped_irradiance": stops(
                    clipping.horizontal(image) / exposure, clipping.horizontal(radiance)
                ),
                "irradiance": stops(clipping.horizontal(result) / exposure, clipping.horizontal(radiance)),
                "true_contrast": shadow.contrast(picture),
                "clipped_contrast": shadow.contrast(pictures[0]),
                "contrast": shadow.contrast(pictures[1]),
            }
        )
        if level in SHOWN:
            for label, one in zip(("clipped", "unclipped"), pictures, strict=True):
                images.write_exr(folder / f"{label}_{level}.exr", one, panorama=False)
    images.write_exr(folder / "truth.exr", picture, panorama=False)
    return rows


def cases(args):
    maps = [(name, file, GROUPS[name in clipping.KEPT]) for name, file in puresky.find().items()]
    maps.sort(key=lambda one: GROUPS.index(one[2]))
    maps += [(name, file, GROUPS[2]) for name, file in puresky.others().items()]
    return [
        calling(name, measure_map, {}, {"map": name, "set": of}, file=str(file), map_name=name)
        for name, file, of in maps
    ]


def measure(done) -> list[dict]:
    """Return the rows of a map; each also has itself as ``sun``, as ``sun`` and ``back``, or as ``other``."""
    rows = []
    for row in done.metrics:
        sun = row if row["sunny"] else None
        back = sun if row["added"] else None
        other = None if row["sunny"] else row
        rows.append({**row, "sun": sun, "back": back, "other": other})
    return rows


def panels(done):
    """Return the shadow under the true map, and for each clipping before and after, at one exposure."""
    labels = ["truth", *(f"{label}_{level}" for level in SHOWN for label in ("clipped", "unclipped"))]
    pictures = [done.picture(label) for label in labels]
    white = 1.5 * np.median(luminance(pictures[0]))
    return [tonemap(picture / white, "gamma") for picture in pictures]


EXPERIMENT = Experiment(
    cases,
    measure,
    {
        "map": "{map}",
        "clipped at": "{level}",
        "called": "{kind}",
        "sun added": lambda row: ("false" if row["false"] else "yes") if row["added"] else "",
        "off, degrees": "{off:.1f}",
        "true sun over sky, stops": "{true_ratio:+.1f}",
        "flux, stops: clipped": "{sun[clipped_flux]:+.1f}",
        "now": "{sun[flux]:+.1f}",
        "expected": "{sun[spread]:.1f}",
        "irradiance, stops: clipped": "{clipped_irradiance:+.2f}",
        "now ": "{irradiance:+.2f}",
        "shadow: truth, clipped, now": "{true_contrast:.2f} {clipped_contrast:.2f} {contrast:.2f}",
    },
    group=lambda row: f"{row['set']}, {'sunny' if row['sunny'] else 'not sunny'}",
    summary=Summary(
        {"maps": "{set}", "clipped at": "{level}"},
        {
            "sunny: sun found": "{back[true_contrast].count} of {sun[true_contrast].count}",
            "flux, stops: clipped": "{sun[clipped_flux].mean:+.1f}",
            "RMS with the sun back (worst)": "{back[flux].rms:.1f} ({back[flux].worst:+.1f})",
            "irradiance, stops: clipped": "{sun[clipped_irradiance].mean:+.2f}",
            "RMS with the sun back": "{back[irradiance].rms:.2f}",
            "shadow: truth": "{sun[true_contrast].mean:.2f}",
            "clipped": "{sun[clipped_contrast].mean:.2f}",
            "with the sun back": "{sun[contrast].mean:.2f}",
            "not sunny: false suns": "{other[false].above[0]} of {other[false].count}",
        },
    ),
    panels=panels,
)
