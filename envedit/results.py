"""What a run found: maps, renderings and figures; to look at and to write."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from envedit import config, inputs
from envedit.config.validators import Integer, named, show
from envedit.core import latlong
from envedit.core.errors import ConfigError, counted
from envedit.core.extras import required
from envedit.export import adjustments, file_resolution
from envedit.losses import metrics
from envedit.report import preview
from envedit.report.variants import Variant
from envedit.representations.layers.separation import Separation
from envedit.scene.scene import View
from envedit.solve.feasibility import Reach
from envedit.solve.map_problem import Posterior
from envedit.targets.photo import Photo

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(repr=False)
class Result:
    """What a run found.

    Attributes
    ----------
    envmap : ndarray (H, W, 3)
        The edited map in the units of its file, which the scene's ``scale`` multiplies; rows outside the
        active ones are the original's, bit for bit, and so are frozen texels but where layers move a light or
        its glow across them.
    renders, maps : dict
        ``initial``, ``target``, ``edited``; linear radiance, of maps as it reaches the scene. Renderings of
        several views stand below each other.
        ``maps["target"]`` is None where it is unknown.
    metrics : dict
        As in metrics.json.
    history : list of dict
        A row an iteration.
    notes, warnings : list of str
        What was chosen automatically; what the user should know.
    views : tuple of View
        Name of each view, and its rows in a rendering.
    lights : dict
        Lights ``before`` and ``after``, of :func:`.light_list.matched`.
    settings : config.Config
        What was carried out.
    influence : ndarray (H, W), optional
        T' 1, how much each texel adds to the picture; None where the renderer does not know.
    frozen : ndarray of bool (H, W), optional
        Active texels that were kept, as this view does not determine them; None as above.
    reach : feasibility.Reach, optional
        How much of a painted request any light can do; None where T is not at hand or nothing was painted.
    posterior : map_problem.Posterior, optional
        How well the target determines the sky; None where that is not known.
    photo : photo.Photo, optional
        The photograph that was the target, with its camera.
    variants : list of Variant
        Other explanations of paint, likeliest first.
    """

    envmap: np.ndarray
    renders: dict
    maps: dict
    metrics: dict
    history: list
    notes: list[str]
    warnings: list[str]
    views: tuple[View, ...]
    lights: dict[str, list[dict]]
    core: np.ndarray  # (H, W, 3), the lights alone in the edited map, radiance that reaches the scene
    settings: config.Config
    to_world: np.ndarray | None = None  # (3, 3), from the map's frame to the scene's
    influence: np.ndarray | None = None
    frozen: np.ndarray | None = None
    scene: Path | None = None  # its file
    reach: Reach | None = None
    input_map: inputs.InputMap | None = None  # the map that was edited
    alpha: np.ndarray | None = None  # (h, w), share of a pixel that sees a surface, where the sky is hidden
    found: file_resolution.Found | None = None  # what the map was decoded from
    posterior: Posterior | None = None
    photo: Photo | None = None
    outliers: np.ndarray | None = None  # bool (h, w), pixels of the photograph that light does not explain
    variants: list[Variant] = field(default_factory=list)
    replacements: inputs.Replacements = inputs.NO_REPLACEMENTS
    base: Path | None = None  # what file names in scene parameters are relative to

    @property
    def separation(self) -> Separation | None:
        """Lights and background of the active rows, where the representation has them."""
        return self.found.representation.separation if self.found else None

    @property
    def rows(self) -> tuple[slice, ...]:
        """Rows of each view in a rendering."""
        return tuple(view.rows for view in self.views)

    @property
    def render(self) -> np.ndarray:
        """The rendering under the edited map, by Mitsuba with fresh samples."""
        return self.renders["edited"]

    @property
    def shown(self) -> dict[str, np.ndarray]:
        """The renderings as pictures and measures show them: beside a photograph, as its camera does."""
        if self.photo is None:
            return self.renders
        return {name: self.photo.displayed(picture) for name, picture in self.renders.items()}

    def __repr__(self) -> str:
        """Say in one line what was found: sizes, and how far the rendering is from the target."""
        height, width, _ = self.envmap.shape
        rows, columns, _ = self.render.shape
        parts = [f"map {width}x{height}", f"rendering {columns}x{rows}"]
        before, after = (self.metrics[name] for name in ("initial", "render"))
        if before["log_rmse"]:  # with a target
            first, last = (metrics.score(one, (before, after)) for one in (before, after))
            steps = counted(self.metrics["iterations"], "step", "steps")
            parts.append(f"{first} before, {last} after {steps}")
        if self.warnings:
            parts.append(counted(len(self.warnings), "warning", "warnings"))
        return f"Result({', '.join(parts)})"

    def _repr_png_(self) -> bytes:
        """Show the renderings over their maps in a notebook."""
        return preview.sheet(self.shown, self.maps, self.settings.output.tonemap, self.rows)

    def plot(self) -> Figure:
        """Draw renderings and maps: initial, target and edited; maps over azimuth and elevation, degrees.

        Display values under ``[output] tonemap``. Needs matplotlib (in a checkout:
        ``pip install '.[report]'``).

        Returns
        -------
        matplotlib.figure.Figure
            ``savefig(file)`` writes it; a notebook shows it.

        Raises
        ------
        MachineError
            matplotlib is not installed.
        """
        drawing = required("matplotlib.figure", "report", "Result.plot")
        figure = drawing.Figure(figsize=(12, 6.5), layout="constrained")
        rows = (self.shown, None), (self.maps, (0, 360, -90, 90))
        for axes, (pictures, extent) in zip(figure.subplots(2, 3), rows, strict=True):
            shown = preview.known(pictures)
            stops = preview.stops_of(shown.values())
            for axis, name in zip(axes, ("initial", "target", "edited"), strict=True):
                if name not in shown:
                    axis.axis("off")
                    continue
                axis.imshow(preview.display(shown[name], self.settings.output.tonemap, stops), extent=extent)
                if extent is None:
                    axis.set(title=f"{name}{preview.exposed(stops)}", xticks=[], yticks=[])
                else:
                    axis.set(xlabel="azimuth, degrees", ylabel="elevation, degrees")
        return figure

    def samples(self, count: int, seed: int = 0) -> np.ndarray:
        """Draw maps that explain the target as well as this one, for what the picture leaves open.

        From the posterior in Laplace's approximation, a Gaussian of the solver's unknowns about the edited
        map: where the picture determines the sky draws agree, elsewhere they differ as the prior lets them.

        Parameters
        ----------
        count : int
            How many.
        seed : int
            Of the draws.

        Returns
        -------
        ndarray (count, H, W, 3) float32
            In the units of :attr:`envmap`.

        Raises
        ------
        ConfigError
            The edit was not solved by Gauss-Newton steps, or these leave open what the posterior is; or
            ``count`` or ``seed`` is no whole number of at least 0.
        """
        count = named("count", Integer(0, 2**31), count)
        seed = named("seed", Integer(0, 2**32 - 1), seed)
        if self.found is None or self.posterior is None or self.posterior.sample is None:
            raise ConfigError('Result.samples: needs an edit by layers with optimizer.kind = "gauss-newton"')
        settings = self.settings
        before = latlong.rotate(self.maps["initial"], self.found.turn_degrees)
        rows = inputs.active_rows(settings.input.rows, len(before)).slice
        rng = np.random.default_rng(seed)
        drawn = []
        for _ in range(count):
            envmap = before.copy()
            envmap[rows] = self.found.representation.decode(self.posterior.sample(rng)).numpy()
            envmap *= np.float32(self.found.level)
            adjusted, _ = adjustments.adjust(envmap, settings.lights, settings.output, self.input_map.scale)
            drawn.append(self.input_map.as_stored(adjusted, self.found.turn_degrees))
        return np.stack(drawn) if drawn else np.zeros((0, *self.envmap.shape), np.float32)

    def save(self, folder: str | PathLike[str]) -> list[str]:
        """Write what a run leaves: maps, renderings, metrics, report, and the configuration to run again.

        Arrays that the edit was given are written too, ``given_*.exr``, and ``config.toml`` names them.

        Parameters
        ----------
        folder : path
            Made if it is not there; what an earlier run left in it is moved to ``earlier-N``.

        Returns
        -------
        list of str
            Warnings.

        Raises
        ------
        ConfigError
            ``folder`` is no path.
        InputError
            The folder cannot be used, or a file cannot be written.
        """
        from envedit.report import output_folder, run_folder

        if not isinstance(folder, str | PathLike):
            raise ConfigError(f"folder: got {show(folder)}, expected a path")
        folder = Path(folder).absolute()
        settings = replace(self.settings, output=replace(self.settings.output, dir=str(folder)))
        warnings = [*self.warnings]
        of_scene = self.replacements.scene.files if self.replacements.scene else ()
        read = [*output_folder.inputs_of(settings, self.base), *of_scene]
        with output_folder.results_in(folder, output_folder.names(folder), read):
            settings = run_folder.write_given(settings, folder, self.replacements, warnings)
            own = replace(self, settings=settings, metrics=copy.deepcopy(self.metrics), warnings=warnings)
            return run_folder.write(folder, own, import_s=0.0)
