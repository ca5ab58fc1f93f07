"""The tables and figures: which rows, which scene, what is varied."""

from __future__ import annotations

from dataclasses import dataclass

from .methods import FITS, METHODS, PAINTED

ROUGHNESS = (0.0, 0.5, 1.0)
"""Of Table 3 and Figure 8."""


@dataclass(frozen=True)
class Kind:
    """What one table or figure asks.

    Attributes
    ----------
    title : str
        Its heading.
    methods : dict
        Methods by name, of which ``rows`` are taken.
    rows : tuple of str
        In the order in which they are shown.
    scene : str
        Scene where none is given; "" for fits.
    roughness : tuple
        Values of the scene's parameter, (None,): as the scene has it.
    several : bool
        Averaged over maps: all of them are taken where none is named.
    """

    title: str
    methods: dict
    rows: tuple[str, ...]
    scene: str = "statue"
    roughness: tuple[float | None, ...] = (None,)
    several: bool = False


_FIRST = ("pixels", "log-pixels", "siren-no-hdr", "siren", "r-siren", "r-siren-reg", "layers")
_OTHERS = (*_FIRST[:4], "siren-reg", *_FIRST[4:])

KINDS = {
    "table1": Kind("Table 1: shifted map", METHODS, _FIRST),
    "table2": Kind("Table 2: full mirror", METHODS, _OTHERS, "mirror"),
    "table3": Kind("Table 3: maps and roughness", METHODS, _OTHERS, "statue", ROUGHNESS, True),
    "figure4": Kind(
        "Figure 4: stock SIREN and SIREN HDR",
        FITS,
        ("stock", "stock-scaled", "siren-no-hdr", "siren", "siren-polished"),
        "",
    ),
    "figure5": Kind(
        "Figure 5: the same noise on weights", FITS, ("siren", "r-siren", "r-siren-polished"), ""
    ),
    "figure8": Kind("Figure 8: roughness", METHODS, ("r-siren-reg", "layers"), "statue", ROUGHNESS),
    "figure9": Kind("Figure 9: regularisers on a painted edit", PAINTED, tuple(PAINTED), ""),
}
