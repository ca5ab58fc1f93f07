"""The tables of how an edit is found: ``[representation]``, ``[fit]``, ``[loss]`` and those that follow."""

from __future__ import annotations

from dataclasses import dataclass

from envedit.config.tables import ADAM_STEPS, EDITED, LAYERS, PAINTED, SIREN, TRANSPORT, Table, key
from envedit.config.validators import WEIGHT, Boolean, Choice, Integer, Number, OrAuto, Ramp, String
from envedit.core import extensions
from envedit.core.errors import ConfigError

_DISTS = {"loss.dists": ()}


@dataclass(frozen=True)
class Representation(Table):
    """What the optimiser's parameters are."""

    kind: str = key(
        "layers",
        Choice("layers", "siren", "pixels", "log-pixels", group=extensions.REPRESENTATIONS),
        "layers (lights and a smooth gain), siren (the paper's), pixels (radiance) or log-pixels",
    )
    cycles: int | str = key(
        "auto",
        OrAuto(Integer(1, 256)),
        "finest detail of the gain; auto: 12, finer where the picture shows the sky itself, as in a mirror",
        "per horizon",
        LAYERS,
    )
    turn: str | bool = key(
        "auto",
        OrAuto(Boolean()),
        'turn the whole sky about the vertical first; "auto": where that explains the target, not for paint',
        when=TRANSPORT | {"input.rows": ("all",)},
    )
    hidden: int = key(128, Integer(1, 4096), "width of a layer", when=SIREN)
    depth: int = key(3, Integer(0, 64), "hidden sine layers after the first", when=SIREN)
    omega: float = key(30.0, Number(0, positive=True), "angular frequency of the sine layers", when=SIREN)
    coordinates: str = key(
        "plane",
        Choice("plane", "sphere"),
        "inputs of the network: row and column as in the paper, or directions",
        when=SIREN,
    )


@dataclass(frozen=True)
class Fit(Table):
    """Fit of the SIREN to the input map (paper, Sec. 4 and 6.1)."""

    epochs: int = key(1200, Integer(0, 10**7), "steps of Adam", "steps")
    lr: float = key(1e-3, Number(0, positive=True), "initial learning rate of Adam")
    beta2: float = key(0.99, Number(0, 0.999999), "Adam's decay of squared gradients")
    stride: int = key(
        2, Integer(1, 64), "a step samples every stride-th row and column, at varying offsets", "texels"
    )
    schedule: str = key(
        "cosine", Choice("cosine", "warm-restarts", "constant"), "course of both learning rates"
    )
    restart_period: int = key(
        100, Integer(1, 10**7), "epochs between restarts", "steps", {"fit.schedule": ("warm-restarts",)}
    )
    log_mse: float = key(0.85, Number(0), "weight of the squared error in normalised log space")
    log_ssim: float = key(0.25, Number(0), "weight of 1 - SSIM in normalised log space")
    hdr: float = key(1e-2, Number(0), "weight of the absolute error of radiance")
    awp_gamma: float = key(0.01, Number(0, 1), "weight perturbation, fraction of a layer's norm; 0: off")
    awp_lr: float = key(
        1e-4,
        Number(0, positive=True),
        "learning rate of the proxy Adam that perturbs",
        when={"fit.awp_gamma": ()},
    )
    awp_every: int = key(
        2, Integer(1, 10**7), "epochs between fresh perturbations", "steps", {"fit.awp_gamma": ()}
    )
    headroom: float = key(0.05, Number(0, 0.45), "share of the network's range left free above and below")
    polish: str = key(
        "auto", Choice("auto", "always", "never"), "finish exactly; auto: unless the fit is to be edited"
    )
    awp_until: float = key(
        0.7, Number(0, 1), "polish: share of the epochs that are perturbed before", when={"fit.awp_gamma": ()}
    )
    light: float = key(1.0, Number(0), "polish: weight of light in the last layer's solution; 0: none")
    cache: bool = key(True, Boolean(), "keep fits on disk and reuse them")

    def _check_together(self) -> None:
        if not self.log_mse + self.log_ssim + self.hdr:
            raise ConfigError("fit.log_mse, fit.log_ssim, fit.hdr: got 0 for all, expected one above 0")


@dataclass(frozen=True)
class Loss(Table):
    """Weights of the edit's losses (Eq. 10): a number, or [start, end] for a geometric ramp over the run."""

    ssim: Ramp = key(0.1, WEIGHT, "1 - SSIM of rendering and target")
    luminance: Ramp = key(0.0, WEIGHT, "change of the map's summed luminance (Eq. 8)")
    l1: Ramp = key(0.0, WEIGHT, "sum of the map's radiance (Eq. 9)")
    dists: Ramp | str = key(
        0.0, OrAuto(WEIGHT), "DISTS of map and original; auto: 0.1 for a SIREN where weights are, else 0"
    )
    tv: Ramp = key(0.0, WEIGHT, "total variation of the map")
    change: Ramp = key(0.0, WEIGHT, "mean change of the map's logarithm: what need not change stays")
    image_l1: Ramp = key(1.0, WEIGHT, "mean absolute difference of rendering and target")
    image_l2: Ramp = key((1.0, 100.0), WEIGHT, "mean squared difference of rendering and target")

    def _check_together(self) -> None:
        if not self.ssim and not self.image_l1 and not self.image_l2:
            raise ConfigError("loss.ssim, loss.image_l1, loss.image_l2: got 0 for all, expected one above 0")


@dataclass(frozen=True)
class Perceptual(Table):
    """Trained weights, as `envedit weights` fetches them; without them DISTS is off and LPIPS null."""

    weights: str = key("", String(), "folder of the files; empty: where `envedit weights` puts them")
    vgg: str = key("", String(), "DISTS: file of VGG16 (npz, torchvision's names)", when=_DISTS)
    dists: str = key("", String(), "DISTS: file of its alpha and beta (npz)", when=_DISTS)
    dists_every: int = key(4, Integer(1, 1000), "DISTS: steps from one evaluation to the next", when=_DISTS)
    network: str = key("alex", Choice("alex", "vgg"), "LPIPS: its network")
    backbone: str = key("", String(), "LPIPS: file of that network (npz)")
    heads: str = key("", String(), "LPIPS: file of its heads, version 0.1 (npz)")

    def _check_together(self) -> None:
        for one, other in (("vgg", "dists"), ("backbone", "heads")):
            if bool(getattr(self, one)) != bool(getattr(self, other)):
                raise ConfigError(f"perceptual.{one}, perceptual.{other}: got one, expected both or none")


@dataclass(frozen=True)
class Optimizer(Table):
    """How the parameters are found."""

    kind: str = key(
        "auto",
        Choice("auto", "gauss-newton", "adam"),
        "gauss-newton (layers through a stored transport) or adam; "
        "auto: gauss-newton where it is possible, otherwise adam",
    )
    iterations: int = key(  # "auto" in files; a number once a run has looked for weights
        100,
        OrAuto(Integer(0, 10**7)),
        "most steps; Gauss-Newton ends after 16, or later where a light was added or moved; "
        "auto: 300 with DISTS, 600 without",
        "steps",
    )
    lr: float | str = key(
        "auto",
        OrAuto(Number(0, positive=True)),
        'learning rate, or "auto": what suits the representation',
        when=ADAM_STEPS,
    )
    beta2: float = key(
        0.99,
        Number(0, 0.999999),
        "Adam's decay of squared gradients; with 0.999 the loss may have spikes",
        when=ADAM_STEPS,
    )
    schedule: str = key(
        "cosine",
        Choice("cosine", "constant"),
        "course of the learning rate; cosine: to 0 at the end of the run",
        when=ADAM_STEPS,
    )
    start: str = key(
        "",
        String(),
        'solution to go on from, which envedit paint saves as painted.npz; "": lights are searched for',
        when={"solver": ("gauss-newton",)} | EDITED,
    )
    checkpoint_s: float = key(
        10.0, Number(0), "time between checkpoints; 0: whenever losses are read back", "seconds"
    )


@dataclass(frozen=True)
class Solve(Table):
    """How far the map may go."""

    freedom: float = key(
        0.25,
        Number(0, 1),
        "painted targets: how far the sky may change beside its lights, in units of how photographed skies "
        "differ; 0: lights, and one factor for the whole sky",
        when=LAYERS | PAINTED,
    )


@dataclass(frozen=True)
class Renderer(Table):
    """How the rendering is computed while editing."""

    kind: str = key(
        "transport",
        Choice("transport", "path", group=extensions.RENDERERS),
        "stored transport, or a path tracer",
        when=EDITED,
    )
    spp: int | str = key(
        "auto",
        OrAuto(Integer(1, 1 << 20)),
        'samples, or "auto": as many as 4 million paths give, 256 at most',
        "per pixel",
        EDITED,
    )
    pixels: int | str = key(
        "auto",
        OrAuto(Integer(64, 1 << 30)),
        'most pixels that the edit is solved on; "auto": 16384 (paint: 4096) by Gauss-Newton, else all',
        "pixels",
        EDITED,
    )
    max_depth: int | str = key("auto", OrAuto(Integer(1, 1024)), "longest path", "segments", EDITED)
    refresh: int | str = key(
        0,
        OrAuto(Integer(0, 10**7)),
        "steps between fresh recordings of the transport; 0 and auto: never",
        "steps",
        TRANSPORT | ADAM_STEPS | EDITED,
    )
    memory_gb: float | str = key(
        2.0,
        OrAuto(Number(0, positive=True)),
        'most memory the transport may take; "auto": 2',
        "GB",
        TRANSPORT | EDITED,
    )
    cache: bool = key(True, Boolean(), "keep transports and renderings on disk and reuse them")
    influence_threshold: float = key(
        1e-3,
        Number(0, 1),
        "texels with less than this share of the mean influence on the rendering keep their value; 0: none",
        when=TRANSPORT | ADAM_STEPS | EDITED,
    )
