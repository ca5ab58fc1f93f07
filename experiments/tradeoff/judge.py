"""How good an edited map is, told alike whatever settings it was made with.

The map that a run leaves, at the resolution of its file where there is one, is brought to one common width
and rendered afresh on one common film. The reference is the true map, turned at the resolution of its file,
rendered with more samples and other seeds: no setting judges itself by its own film, samples or transport.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np

from envedit import inputs
from envedit.core import latlong
from envedit.core.atomic_files import write_atomically
from envedit.core.color import luminance, tonemap
from envedit.images import images
from envedit.losses import metrics
from envedit.scene import scene

from .plan import ANGLE, SCENES, Cell, Setting, job_of

WIDTH, FILM = 512, 128
"""Texels and pixels across, of every map and rendering that is judged."""
SPP, TRUE_SPP = 1024, 4096
SEED, TRUE_SEED = 5_000_011, 6_000_011
"""Apart from those of targets and results in the runs."""
SUNNY = 1000.0
"""Peak radiance from which on a map has a sun whose place can be told."""
_VERSION = 1  # raise when the same map would be judged otherwise


class Judge:
    """Judge maps; ``judge(cell, folder)``.

    Parameters
    ----------
    out : Path
        Folder of all jobs, where bounds are kept.
    spp, true_spp : int
        Samples a pixel of renderings that are judged, and of references.
    width, film : int
        Texels and pixels across.
    """

    def __init__(
        self, out: Path, spp: int = SPP, true_spp: int = TRUE_SPP, width: int = WIDTH, film: int = FILM
    ):
        self.out, self.spp, self.true_spp, self.width, self.film = Path(out), spp, true_spp, width, film
        self._of = [_VERSION, spp, true_spp, width, film, ANGLE]
        self._cells, self._scenes = {}, {}

    def __call__(self, cell: Cell, folder: Path) -> dict:
        """Judge what a run left, once; see :meth:`compare` for the numbers of ``full`` map and rendering.

        Returns
        -------
        dict
            ``render``, ``map``, ``sun_degrees`` as :meth:`compare`; ``working``: metrics of ``edited.exr``
            itself, resized, against the true map; ``own``: what the run said of its rendering;
            ``loss_noise`` as :func:`loss_noise`; ``timing``: seconds by part; ``notes``.
        """
        kept = folder / "judged.json"
        if found := self._kept(kept):
            return found
        full = folder / "edited_full.exr"
        working = self._sized(images.read(str(folder / "edited.exr"))[0])
        edited = self._sized(images.read(str(full))[0]) if full.exists() else working
        own = json.loads((folder / "metrics.json").read_text())
        with open(folder / "history.csv", newline="") as file:
            losses = [float(row["loss"]) for row in csv.DictReader(file) if row.get("loss")]
        found = {"of": self._of, "full": full.exists(), **self.compare(cell, edited)}
        found |= {
            "working": metrics.compare(working[self._rows()], self.true(cell)[0][self._rows()]),
            "own": own["render"]["psnr"],
            "loss_noise": loss_noise(losses),
            "iterations": own["iterations"],
            "timing": own["timing"],
            "transport": own["transport"],
            "notes": own["choices"],
        }
        _write(kept, found)
        return found

    def compare(self, cell: Cell, edited: np.ndarray) -> dict:
        """Render a map (H, W, 3) of the judge's size and compare it with the true one.

        Returns
        -------
        dict
            ``render``: psnr, ssim, mse of all samples against all of the reference's, and
            ``psnr_without_noise``, see :func:`without_noise`; ``map``: psnr, ssim, mse of the upper half;
            ``sun_degrees``: angle between the brightest texels, None where the true map has no sun.
        """
        true, wanted = self.true(cell)
        halves = self._halves(cell, edited, self.spp, SEED)
        rows, place = self._rows(), latlong.directions(*true.shape[:2])
        peaks = [place[metrics.peak_position(m[rows])] for m in (edited, true)]
        sunny = luminance(true[rows]).max() > SUNNY
        # From the chord: an angle near 0 has no digits left in its cosine.
        angle = 2 * np.degrees(np.arcsin(min(np.linalg.norm(peaks[0] - peaks[1]) / 2, 1.0)))
        render = metrics.compare(halves.mean(axis=0), wanted.mean(axis=0))
        render["psnr_without_noise"] = without_noise(halves, wanted)
        return {
            "render": render,
            "map": metrics.compare(edited[rows], true[rows]),
            "sun_degrees": float(angle) if sunny else None,
        }

    def bounds(self, cell: Cell) -> dict:
        """Judge the map as it was before the edit, and the true map: the floor, and the most noise allows.

        Returns
        -------
        dict
            ``unedited`` and ``ceiling``, as :meth:`compare`; kept on disk.
        """
        kept = self.out / f"bounds-{job_of(cell, Setting('bounds', '', {})).key}.json"
        if found := self._kept(kept):
            return found
        original = self._sized(images.load_envmap(str(cell.file))[0])
        true = self.true(cell)[0]
        found = {
            "of": self._of,
            "unedited": self.compare(cell, original),
            "ceiling": self.compare(cell, true),
        }
        _write(kept, found)
        return found

    def _kept(self, path):
        """Read what was judged before, if it was judged in the same way."""
        try:
            found = json.loads(path.read_text())
            return found if found["of"] == self._of else None
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def true(self, cell: Cell) -> tuple[np.ndarray, np.ndarray]:
        """Return the true map (H, W, 3) and two independent renderings under it, (2, h, w, 3)."""
        if cell not in self._cells:
            source = images.load_envmap(str(cell.file))[0]
            true = self._sized(latlong.rotate(source, ANGLE))
            self._cells[cell] = true, self._halves(cell, true, self.true_spp, TRUE_SEED)
        return self._cells[cell]

    def _sized(self, envmap):
        return latlong.resize(envmap, self.width // 2, self.width)

    def _rows(self):
        return inputs.active_rows("upper", self.width // 2).slice

    def _halves(self, cell, envmap, spp, seed):
        """Render twice with half of the samples each, (2, h, w, 3) float64."""
        if cell.scene not in self._scenes:
            given = SCENES[cell.scene]
            self._scenes[cell.scene] = scene.load(
                given["file"], self.film, self.film, given.get("parameters", {})
            )
        lit = self._scenes[cell.scene]
        return np.stack(
            [lit.render(envmap, spp=max(spp // 2, 1), seed=seed + i) for i in range(2)], dtype=np.float64
        )


def _write(path, found):
    write_atomically(path, (json.dumps(found, indent=1, allow_nan=False) + "\n").encode())


def without_noise(halves: np.ndarray, wanted: np.ndarray) -> float:
    """Estimate the PSNR of two renderings from two independent ones of each, (2, h, w, 3).

    With a_1, a_2 and b_1, b_2 independent, E[(a_1 - b_1)(a_2 - b_2)] = (E a - E b)^2: their noise has no
    square in it. On display values, whose curve turns noise into a bias of second order. The estimate may
    come out negative for equal pictures, which is the cap of :func:`envedit.losses.metrics.psnr`.
    """
    a, b = tonemap(halves, "gamma"), tonemap(wanted, "gamma")
    square = float(np.mean((a[0] - b[0]) * (a[1] - b[1])))
    return float(min(metrics.PSNR_CAP, -10 * np.log10(square))) if square > 0 else metrics.PSNR_CAP


def loss_noise(losses) -> float | None:
    """Estimate the relative noise of a loss from step to step over the last third of a run.

    The root mean square of second differences over sqrt(6), which is the standard deviation of independent
    noise and knows nothing of a linear trend, over the mean. None for fewer than 9 steps or a mean of 0.
    """
    last = np.asarray(losses, np.float64)[-(len(losses) // 3) :]
    if len(losses) < 9 or not last.mean() > 0:
        return None
    return float(np.sqrt(np.mean(np.square(np.diff(last, 2))) / 6) / last.mean())
