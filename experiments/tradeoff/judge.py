"""How good an edited map is, told alike whatever settings it was made with.

The map that a run leaves, at the resolution of its file where there is one, is brought to one common width
and rendered afresh on one common film. The reference is the true map, turned at the resolution of its file,
rendered with more samples and other seeds: no setting judges itself by its own film, samples or transport.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from envedit import config, inputs
from envedit.core import latlong
from envedit.core.color import luminance, tonemap
from envedit.images import images
from envedit.losses import metrics
from envedit.scene import scene
from experiments.measures import peak_error

WIDTH, FILM = 512, 128
"""Texels and pixels across, of every map and rendering that is judged."""
SPP, TRUE_SPP = 1024, 4096
SEED, TRUE_SEED = 5_000_011, 6_000_011
"""Apart from those of targets and results in the runs."""
SUNNY = 1000.0
"""Peak radiance from which on a map has a sun whose place can be told."""


class Judge:
    """Judge maps that were to be turned as ``settings`` say, in their scene."""

    def __init__(self, settings: config.Config):
        self._scene = scene.load(settings.scene.file, FILM, FILM, settings.scene.parameters)
        self._rows = inputs.active_rows("upper", WIDTH // 2).slice
        source = images.load_envmap(settings.input.envmap)[0]
        self.original = self._sized(source)  # (H, W, 3), before the edit
        self.true = self._sized(latlong.rotate(source, settings.target.degrees))
        self.target = self._halves(self.true, TRUE_SPP, TRUE_SEED)  # (2, h, w, 3)

    def __call__(self, folder: Path) -> dict:
        """Judge what a run left, at the resolution of its file where it has that.

        Returns the numbers of :meth:`compare`, and ``timing``: seconds of the run by part.
        """
        full = folder / "edited_full.exr"
        edited = images.read(str(full if full.exists() else folder / "edited.exr"))[0]
        timing = json.loads((folder / "metrics.json").read_text())["timing"]
        return self.compare(self._sized(edited)) | {"timing": timing}

    def compare(self, edited: np.ndarray) -> dict:
        """Render a map (H, W, 3) of the judge's size and compare it with the true one.

        Returns
        -------
        dict
            ``render``: psnr, ssim, mse of all samples against all of the reference's, and
            ``psnr_without_noise``, see :func:`without_noise`; ``map``: psnr, ssim, mse of the upper half;
            ``sun_degrees``: angle between the brightest texels, None where the true map has no sun.
        """
        halves = self._halves(edited, SPP, SEED)
        rows = self._rows
        sunny = luminance(self.true[rows]).max() > SUNNY
        render = metrics.compare(halves.mean(axis=0), self.target.mean(axis=0))
        render["psnr_without_noise"] = without_noise(halves, self.target)
        return {
            "render": render,
            "map": metrics.compare(edited[rows], self.true[rows]),
            "sun_degrees": peak_error(edited, self.true) if sunny else None,
        }

    def bounds(self) -> dict:
        """Judge the map as it was before the edit, and the true map: the least, and the most noise allows."""
        return {"unedited": self.compare(self.original), "true": self.compare(self.true)}

    def _sized(self, envmap):
        return latlong.resize(envmap, WIDTH // 2, WIDTH)

    def _halves(self, envmap, spp, seed):
        """Render twice with half of the samples each, (2, h, w, 3) float64."""
        pictures = [self._scene.render(envmap, spp=max(spp // 2, 1), seed=seed + i) for i in range(2)]
        return np.stack(pictures, dtype=np.float64)


def without_noise(halves: np.ndarray, wanted: np.ndarray) -> float:
    """Estimate the PSNR of two renderings from two independent ones of each, (2, h, w, 3).

    With a_1, a_2 and b_1, b_2 independent, E[(a_1 - b_1)(a_2 - b_2)] = (E a - E b)^2: their noise has no
    square in it. On display values, whose curve turns noise into a bias of second order. The estimate may
    come out negative for equal pictures, which is the cap of :func:`envedit.losses.metrics.psnr`.
    """
    a, b = tonemap(halves, "gamma"), tonemap(wanted, "gamma")
    square = float(np.mean((a[0] - b[0]) * (a[1] - b[1])))
    return float(min(metrics.PSNR_CAP, -10 * np.log10(square))) if square > 0 else metrics.PSNR_CAP
