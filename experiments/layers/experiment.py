"""Turn real maps by 60 and by 140 degrees, layers and robust SIREN on the same work."""

import itertools

import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance
from envedit.losses import metrics
from experiments import puresky
from experiments.harness import Case, Done, Experiment, markdown

SUNNY = 1000.0
"""Peak radiance, 256 texels wide, from which on a map is called sunny."""
LIGHT_DEGREES = 6.0
"""The flux of a light is what lies within this angle of the true map's brightest texel."""
NAMES = {"layers": "layers", "siren": "R-SIREN"}
SCENES = {"sphere": {"file": "sphere", "parameters": {"roughness": 0.3}}, "statue": {"file": "statue"}}


def cases(given):
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
    """Return metrics; peak of the original, flux of the light over the true one's, high frequencies.

    High frequencies: metrics.high_frequency_energy (log luminance less its 5 x 5 binomial blur) over the
    original's, and the same of the true map, which a turn by part of a texel changes; active rows all.
    """
    found, rows = done.metrics, done.rows
    original, edited, true = done.maps
    directions = latlong.directions(*true.shape[:2])[rows]
    omega = latlong.solid_angles(*true.shape[:2])[rows, None]
    row, column = metrics.peak_position(true[rows])
    near = directions @ directions[row, column] > np.cos(np.radians(LIGHT_DEGREES))
    flux = [float((luminance(m[rows]) * omega)[near].sum()) for m in (edited, true)]
    sharp = [metrics.high_frequency_energy(m[rows]) for m in (edited, original, true)]
    before = {f"unedited_{key}": value for key, value in found["initial_envmap"].items()}
    return before | {
        "sunny": float(luminance(original[rows]).max()) > SUNNY,
        "render": found["render"]["psnr"],
        "render_ssim": found["render"]["ssim"],
        "initial": found["initial"]["psnr"],
        "psnr": found["envmap"]["psnr"],
        "ssim": found["envmap"]["ssim"],
        "gain": found["envmap"]["psnr"] - found["initial_envmap"]["psnr"],
        "lpips": found["envmap"]["lpips"],
        "off": found["sun_offset_texels"],
        "flux": flux[0] / flux[1],
        "sharp": sharp[0] / sharp[1],
        "true_sharp": sharp[2] / sharp[1],
        "seconds": found["timing"]["total_s"],
    }


def lpips(m) -> str:
    """Return LPIPS of the edited map, and of the unedited one in brackets; - without weights."""
    return "-" if m["lpips"] is None else f"{m['lpips']:.4f} ({m['unedited_lpips']:.3f})"


COLUMNS = {
    "map": lambda m: m["map"] + " (sunny)" * m["sunny"],
    "": "{kind}",
    "rendering PSNR (unedited)": "{render:.1f} ({initial:.1f})",
    "SSIM": "{render_ssim:.3f}",
    "map PSNR (unedited)": "{psnr:.1f} ({unedited_psnr:.1f})",
    "gain": "{gain:+.1f}",
    "SSIM (unedited)": "{ssim:.3f} ({unedited_ssim:.3f})",
    "LPIPS (unedited)": lpips,
    "light off, texels": lambda m: f"{m['off']:.1f}" if m["sunny"] else "-",
    "flux": lambda m: f"{m['flux']:.2f}" if m["sunny"] else "-",
    "high frequencies (true map)": "{sharp:.2f} ({true_sharp:.2f})",
    "s": "{seconds:.0f}",
}


def summary(rows) -> str:
    """Return means and extremes over the runs of each kind."""
    lines = []
    for kind, what in itertools.product(dict.fromkeys(m["kind"] for m in rows), ("sunny", "all")):
        if not (some := [m for m in rows if m["kind"] == kind and (what == "all" or m["sunny"])]):
            continue
        keys = "render", "render_ssim", "psnr", "gain", "ssim", "off", "flux", "sharp", "seconds"
        of = {key: np.array([m[key] for m in some], float) for key in keys}
        light = ["-", "-"]
        seen = [m["lpips"] for m in some if m["lpips"] is not None]
        if what == "sunny":
            light = [f"at most {of['off'].max():.1f}", f"{of['flux'].min():.2f} to {of['flux'].max():.2f}"]
        lines.append(
            [
                f"**{what}, {len(some)} runs**",
                kind,
                f"mean {of['render'].mean():.1f}, worst {of['render'].min():.1f}",
                f"{of['render_ssim'].mean():.3f}",
                f"{of['psnr'].mean():.1f}",
                f"mean {of['gain'].mean():+.1f}, worst {of['gain'].min():+.1f}",
                f"{of['ssim'].mean():.3f}",
                f"{np.mean(seen):.4f}, worst {np.max(seen):.3f}" if seen else "-",
                *light,
                f"{of['sharp'].min():.2f} to {of['sharp'].max():.2f}",
                f"median {np.median(of['seconds']):.0f}",
            ]
        )
    return markdown(["", *list(COLUMNS)[1:]], lines)


EXPERIMENT = Experiment(
    "layers",
    "Turn real maps by 60 and by 140 degrees, layers and robust SIREN on the same work.",
    cases,
    measure,
    COLUMNS,
    group=lambda m: f"{m['scene']}, turned by {m['angle']} degrees",
    summary=summary,
    sheet=lambda case: "{scene}_{angle}".format(**case.about),
)
