"""Turn real maps by 60 and by 140 degrees, layers and robust SIREN on the same work."""

import itertools

import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance
from envedit.losses import metrics
from experiments import puresky
from experiments.harness import Case, Done, Experiment
from experiments.summary import Summary

SUNNY = 1000.0
"""Peak radiance, 256 texels wide, from which on a map is called sunny."""
LIGHT_DEGREES = 6.0
"""The flux of a light is what lies within this angle of the true map's brightest texel."""
NAMES = {"layers": "layers", "siren": "R-SIREN"}
SCENES = {"sphere": {"file": "sphere", "parameters": {"roughness": 0.3}}, "statue": {"file": "statue"}}


def cases(args):
    return [
        Case(
            f"{kind}-{scene}-{angle}-{name}",
            {
                "input": {"envmap": str(file), "width": 256},
                "scene": SCENES[scene],
                "target": {"rotate_degrees": angle},
                "representation": {"kind": kind},
            },
            {"map": name, "scene": scene, "angle": angle, "kind": NAMES[kind]},
        )
        for scene, angle, (name, file), kind in itertools.product(
            SCENES, (60, 140), puresky.find().items(), NAMES
        )
    ]


def measure(done: Done) -> dict:
    """Return metrics; whether the map is sunny, flux of the light over the true one's, high frequencies.

    High frequencies: metrics.high_frequency_energy (log luminance less its 5 x 5 binomial blur) over the
    original's, and the same of the true map, which a turn by part of a texel changes; active rows all.
    """
    rows = done.rows
    original, edited, true = done.maps
    directions = latlong.directions(*true.shape[:2])[rows]
    omega = latlong.solid_angles(*true.shape[:2])[rows, None]
    near = directions @ directions[metrics.peak_position(true[rows])] > np.cos(np.radians(LIGHT_DEGREES))
    flux = [float((luminance(m[rows]) * omega)[near].sum()) for m in (edited, true)]
    sharp = [metrics.high_frequency_energy(m[rows]) for m in (edited, original, true)]
    sunny = float(luminance(original[rows]).max()) > SUNNY
    return {
        **done.metrics,
        "sunny": " (sunny)" * sunny,
        "gain": done.metrics["envmap"]["psnr"] - done.metrics["initial_envmap"]["psnr"],
        "off": done.metrics["sun_offset_texels"] if sunny else None,
        "flux": flux[0] / flux[1] if sunny else None,
        "sharp": sharp[0] / sharp[1],
        "true_sharp": sharp[2] / sharp[1],
    }


def summary(rows) -> str:
    """Return means and extremes over the runs of each kind, of sunny maps and of all."""
    some = [row | {"of": "sunny"} for row in rows if row["sunny"]] + [row | {"of": "all"} for row in rows]
    return STATISTICS(some)


STATISTICS = Summary(
    {"": "{kind}", "maps": "{of}"},
    {
        "runs": "{runs}",
        "rendering PSNR (worst)": "{render[psnr].mean:.1f} ({render[psnr].min:.1f})",
        "SSIM": "{render[ssim].mean:.3f}",
        "map PSNR": "{envmap[psnr].mean:.1f}",
        "gain (worst)": "{gain.mean:+.1f} ({gain.min:+.1f})",
        "map SSIM": "{envmap[ssim].mean:.3f}",
        "LPIPS (worst)": "{envmap[lpips].mean:.4f} ({envmap[lpips].max:.3f})",
        "light off, texels, at most": "{off.max:.1f}",
        "flux": "{flux.min:.2f} to {flux.max:.2f}",
        "high frequencies": "{sharp.min:.2f} to {sharp.max:.2f}",
        "s, median": "{timing[total_s].median:.0f}",
    },
)
COLUMNS = {
    "map": "{map}{sunny}",
    "": "{kind}",
    "rendering PSNR (unedited)": "{render[psnr]:.1f} ({initial[psnr]:.1f})",
    "SSIM": "{render[ssim]:.3f}",
    "map PSNR (unedited)": "{envmap[psnr]:.1f} ({initial_envmap[psnr]:.1f})",
    "gain": "{gain:+.1f}",
    "SSIM (unedited)": "{envmap[ssim]:.3f} ({initial_envmap[ssim]:.3f})",
    "LPIPS (unedited)": "{envmap[lpips]:.4f} ({initial_envmap[lpips]:.3f})",
    "light off, texels": "{off:.1f}",
    "flux": "{flux:.2f}",
    "high frequencies (true map)": "{sharp:.2f} ({true_sharp:.2f})",
    "s": "{timing[total_s]:.0f}",
}


EXPERIMENT = Experiment(
    cases,
    measure,
    COLUMNS,
    group=lambda m: f"{m['scene']}, turned by {m['angle']} degrees",
    summary=summary,
    sheet=lambda case: "{scene}_{angle}".format(**case.about),
)
