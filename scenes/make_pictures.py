"""Make the pictures of the start page of ``envedit paint``: scenes, painted examples, the analytic sky.

    python scenes/make_pictures.py

writes ``envedit/cli/paint/page/*.jpg``, in seconds.
"""

from pathlib import Path

import mitsuba as mi
import numpy as np

import envedit
from envedit import inputs
from envedit.cli import run
from envedit.core import shipped
from envedit.core.color import luminance, tonemap
from envedit.targets import strokes

PAGE = Path(envedit.__file__).parent / "cli" / "paint" / "page"
WIDTH, MAP_WIDTH = 160, 240
SPP = 256
QUALITY = 85


def write(name: str, picture: np.ndarray) -> None:
    """Write a picture (h, w, 3) of linear radiance, of which 95 % is below white."""
    shown = tonemap(picture / np.quantile(luminance(picture), 0.95))
    codes = np.round(255 * np.clip(shown, 0, 1)).astype(np.uint8)
    mi.Bitmap(codes).write(str(PAGE / f"{name}.jpg"), quality=QUALITY)


def main() -> None:
    """Write all pictures."""
    mi.set_variant("llvm_ad_rgb")
    write("map-sunsky", envedit.sunsky(MAP_WIDTH))
    edits = [name for name in shipped.configurations() if name.startswith("edits/")]
    for name in [*shipped.complete_scenes(), *edits]:
        settings, _, _ = run.load(name, None, [f"scene.width={WIDTH}"])
        scene = inputs.load_scene(settings.scene)
        envmap, _ = inputs.load_map(settings.input, scene)
        picture = scene.render(envmap, SPP, seed=0)
        if settings.target.strokes:
            picture = strokes.paint(picture, settings.target.strokes, settings.target.display_tonemap).picture
        write(name.replace("edits/", "edit-") if "/" in name else f"scene-{name}", picture)


if __name__ == "__main__":
    main()
