"""A ball put into the photograph under a map, beside the ball rendered under the photograph's own light."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import envedit
from envedit import config
from envedit.core import shipped
from envedit.losses import metrics
from envedit.scene.scene import Scene
from envedit.targets.photo import Camera


def ball(x: float, z: float, radius: float, colour: str, alpha: float) -> str:
    """Return a glossy ball on the ground, and the end of its scene."""
    return f"""<shape type="sphere">
    <point name="center" x="{x}" y="{radius}" z="{z}"/> <float name="radius" value="{radius}"/>
    <bsdf type="roughplastic">
        <rgb name="diffuse_reflectance" value="{colour}"/> <float name="alpha" value="{alpha}"/>
    </bsdf>
</shape>
</scene>"""


BALL = ball(x=1.1, z=1.5, radius=0.35, colour="0.5, 0.5, 0.5", alpha=0.1)
HIDDEN = '<integrator type="path"> <boolean name="hide_emitters" value="true"/> </integrator>'
SPP = 256
SHOWN = 0.02, 0.98
"""Display values between which a plate says how a map is exposed."""


def composed(
    plate: np.ndarray, outline: np.ndarray, with_object: np.ndarray, without: np.ndarray
) -> np.ndarray:
    """Return the plate with the object: its own pixels, and around it what it changes, as a factor.

    All are radiance (h, w, 3); the outline (h, w, 1) is 1 where the object is.
    """
    return outline * with_object + (1 - outline) * plate * with_object / np.maximum(without, 1e-6)


def scenes_of(
    scene: str, first: str, inserted: str, folder: Path, width: int, height: int = 0
) -> dict[str, Scene]:
    """Load a scene "without" and "with" what is inserted, and that "alone"; their files go to a folder.

    ``first`` is the beginning of the first thing that is seen in the scene. A height of 0 is by the film's
    aspect ratio.
    """
    texts = {
        "without": scene,
        "with": scene.replace("</scene>", inserted),
        "alone": scene.split(first)[0] + HIDDEN + inserted,
    }
    scenes = {}
    for name, text in texts.items():
        file = folder / f"{name}.xml"
        file.write_text(text)
        scenes[name] = envedit.load_scene(file, width=width, height=height)
    return scenes


class Plate:
    """A photograph without noise, and the scene with and without the ball.

    It is taken of a shipped scene under the ``true`` map (H, W, 3); the scenes with the ball go to
    ``folder``.
    """

    def __init__(self, chosen: config.Scene, true: np.ndarray, camera: Camera, folder: Path):
        shapes = shipped.folder()
        scene = (shapes / f"{Path(chosen.file).stem}.xml").read_text()
        scene = scene.replace('value="statue.ply"', f'value="{shapes / "statue.ply"}"')
        self.scenes = scenes_of(scene, '<shape type="rectangle"', BALL, folder, chosen.width)
        self.outline = self.scenes["alone"].alpha[..., None]
        self.values, self.true = (camera.shown(self._render(name, true)) for name in ("without", "with"))

    def _render(self, name, envmap):
        return self.scenes[name].render(envmap, SPP).astype(np.float64)

    def inserted(self, envmap: np.ndarray, curve: str) -> dict:
        """Put the ball in under a map, exposed for each channel as the plate is in the median.

        Returns RMSE and SSIM of the display values, against the ball under the photograph's map.
        """
        without, with_ball = (self._render(name, envmap) for name in ("without", "with"))
        plate = Camera(curve).radiance(np.minimum(self.values, SHOWN[1]))
        told = (self.values > SHOWN[0]) & (self.values < SHOWN[1]) & (without > 0) & (plate > 0)
        ratio = np.where(told, plate, np.nan) / np.where(told, without, 1)
        camera = Camera(curve, np.log(np.nanmedian(ratio, axis=(0, 1))))
        shown = camera.shown(composed(camera.radiance(self.values), self.outline, with_ball, without))
        error = float(np.sqrt(np.mean((shown - self.true) ** 2)))
        return {"insertion RMSE": error, "insertion SSIM": metrics.ssim(shown, self.true)}
