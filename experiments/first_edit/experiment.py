"""Turn real maps by 60 degrees: three representations, one scene."""

import itertools

from experiments import puresky
from experiments.harness import Case, Done, Experiment, markdown

MAPS = ("kloofendal_48d_partly_cloudy", "autumn_field", "wasteland_clouds", "overcast_soil")
NAMES = {"siren": "R-SIREN", "pixels": "Pixels", "log-pixels": "Log(pixels)"}


def cases(given):
    maps = puresky.chosen(given.maps)
    return [
        Case(
            f"{name}-{kind}",
            {
                "input": {"envmap": str(maps[name]), "width": 256, "rows": "upper"},
                "scene": {"file": "sphere", "parameters": {"roughness": 0.3}},
                "target": {"rotate_degrees": 60.0, "spp": 2048},
                "output": {"spp": 2048},
                "representation": {"kind": kind, "turn": False},
            },
            {"map": name, "kind": NAMES[kind]},
        )
        for name, kind in itertools.product(maps, NAMES)
    ]


def measure(done: Done) -> dict:
    m = done.metrics
    timing, fit = m["timing"], m["fit"]
    return {
        "render": m["render"]["psnr"],
        "render_ssim": m["render"]["ssim"],
        "initial": m["initial"]["psnr"],
        "psnr": m["envmap"]["psnr"],
        "ssim": m["envmap"]["ssim"],
        "unedited": m["initial_envmap"]["psnr"],
        "off": m["sun_offset_texels"],
        "fit": "kept" if fit and fit["cached"] else f"{timing['fit_s']:.0f}",
        "edit": timing["edit_s"],
        "total": timing["total_s"],
    }


COLUMNS = {
    "map": "{map}",
    "representation": "{kind}",
    "rendering PSNR (unedited)": "{render:.2f} ({initial:.2f})",
    "SSIM": "{render_ssim:.3f}",
    "map PSNR (unedited)": "{psnr:.2f} ({unedited:.2f})",
    "map SSIM": "{ssim:.3f}",
    "sun off, texels": "{off:.1f}",
    "fit s": "{fit}",
    "edit s": "{edit:.0f}",
    "total s": "{total:.0f}",
}


def summary(rows) -> str:
    """Return the means of each representation."""
    lines = []
    for kind in dict.fromkeys(m["kind"] for m in rows):
        some = [m for m in rows if m["kind"] == kind]
        means = {k: sum(m[k] for m in some) / len(some) for k in ("render", "render_ssim", "psnr", "ssim")}
        forms = zip(means.values(), (2, 3, 2, 3), strict=True)
        lines.append([f"mean of {len(some)}", kind, *(f"{value:.{digits}f}" for value, digits in forms)])
    return markdown(["", "representation", "rendering PSNR", "SSIM", "map PSNR", "map SSIM"], lines)


EXPERIMENT = Experiment(
    "first_edit",
    "Turn real maps by 60 degrees: three representations, one scene.",
    cases,
    measure,
    COLUMNS,
    summary=summary,
    sheet=lambda case: case.about["map"],
    options=lambda parser: parser.add_argument("--maps", nargs="+", default=MAPS, metavar="NAME"),
)
