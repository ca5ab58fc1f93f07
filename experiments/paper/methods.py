"""The rows of the tables: what each method sets, under the paper's settings and under ours.

"paper" is the preset of that name: Sec. 6 to the letter, rendered by a path tracer with fresh samples at
every step. "ours" is the standard preset: the stored transport, and losses on pictures beside the SSIM.
"""

from __future__ import annotations

from dataclasses import dataclass

from envedit.losses.perceptual.installed import DISTS_WEIGHT

PRESETS = {"paper": "paper", "ours": "standard"}
"""Preset of either settings."""

REGULARISERS = {"luminance": [1e-4, 1e-8], "l1": [1e-4, 1e-8], "dists": 0.6}
"""L_reg, Eq. 10 with the weights of Sec. 6.2; DISTS is off where no weights are named."""
NO_REGULARISERS = {"luminance": 0.0, "l1": 0.0, "dists": 0.0}

PIXEL_RATES = {"pixels": 2e-4, "log-pixels": 1e-4}
"""Learning rates of the paper's pixel rows, which gives none: of those that change anything, the best by the
mean rendering of two maps (docs/decisions/experiment_paper.md)."""


@dataclass(frozen=True)
class Method:
    """A row of a table: its title, and the tables of the configuration that make it."""

    title: str
    tables: dict

    def under(self, settings: str) -> dict:
        """Return the configuration's tables under "paper" or "ours", with the preset."""
        tables = {"preset": PRESETS[settings], **self.tables}
        kind = tables["representation"]["kind"]
        # The paper's task: the upper rows of a turned map, for models that cannot turn it.
        tables["input"] = {"rows": "upper"}
        tables["representation"] = tables["representation"] | {"turn": False}
        if settings == "paper" and kind in PIXEL_RATES:
            tables["optimizer"] = {"lr": PIXEL_RATES[kind]}
        return tables


def _siren(title, regularised, **fit):
    loss = REGULARISERS if regularised else NO_REGULARISERS
    return Method(title, {"representation": {"kind": "siren"}, "fit": fit, "loss": loss})


def _plain(title, kind, loss=NO_REGULARISERS):
    return Method(title, {"representation": {"kind": kind}, "loss": loss})


METHODS = {
    "pixels": _plain("Pixels", "pixels"),
    "pixels-reg": _plain("Pixels + L_reg", "pixels", loss=REGULARISERS),
    "log-pixels": _plain("Log(Pixels)", "log-pixels"),
    "log-pixels-reg": _plain("Log(Pixels) + L_reg", "log-pixels", loss=REGULARISERS),
    "siren-no-hdr": _siren("SIREN HDR w/o L_hdr", False, hdr=0.0, awp_gamma=0.0),
    "siren": _siren("SIREN HDR", False, awp_gamma=0.0),
    "siren-reg": _siren("SIREN HDR + L_reg", True, awp_gamma=0.0),
    "r-siren": _siren("R-SIREN HDR", False, awp_gamma=0.01),
    "r-siren-reg": _siren("R-SIREN HDR + L_reg", True, awp_gamma=0.01),
    "r-siren-own": Method(
        "R-SIREN HDR, our losses",
        {
            "representation": {"kind": "siren"},
            "fit": {"awp_gamma": 0.01},
            "loss": {"dists": DISTS_WEIGHT},
        },
    ),
    "layers": _plain("Layers (ours)", "layers"),
}
"""Rows of the tables."""


def _painted(title, **changed):
    """Return a column of Figure 9: R-SIREN of a painted edit, luminance at a tenth ("reduced")."""
    weights = REGULARISERS | {"luminance": [1e-5, 1e-9], "dists": 0.0} | changed
    return Method(title, {"representation": {"kind": "siren"}, "fit": {"awp_gamma": 0.01}, "loss": weights})


PAINTED = {
    "none": _painted("R-SIREN HDR", luminance=0.0, l1=0.0),
    "lum-l1": _painted("+ L_lum + L_l1"),
    "lum-l1-dists": _painted("+ L_lum + L_l1 + L_dists", dists=0.6),
    "layers-painted": Method("Layers (ours)", {"representation": {"kind": "layers"}}),
}
"""Columns of Figure 9."""

ONLY_OURS = ("r-siren-own", "layers", "layers-painted")
"""Rows that the paper's settings do not have."""
