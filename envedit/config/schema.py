"""The configuration as a whole: the tables of what is left behind, all tables, and every key by name.

What depends on two keys at once is checked when the dataclasses are built, however they are. Whether input
files exist is not looked at here: the modules that read them say so. The file is read in
:mod:`envedit.config.toml`.

>>> FIELDS["fit"]["epochs"].metadata["check"], FIELDS["fit"]["epochs"].metadata["unit"]
(Integer(low=0, high=10000000, even=False), 'steps')
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import Field, dataclass, fields
from typing import Any

from envedit.config import presets
from envedit.config.input_schema import Input, Scene, Target
from envedit.config.method_schema import Fit, Loss, Optimizer, Perceptual, Renderer, Representation, Solve
from envedit.config.tables import ADAM_STEPS, EDITED, SIREN, Table, key, table_key
from envedit.config.validators import KELVIN, Boolean, Choice, Integer, Number, OrAuto, String
from envedit.core.color import TONEMAPS
from envedit.core.errors import ConfigError


@dataclass(frozen=True)
class Lights(Table):
    """What is done to the lights of the edited map at last; their flux is kept."""

    max_radiance: float = key(
        0.0, Number(0), "spread lights until no texel of the map's file is above; 0: no bound", "radiance"
    )
    soften_degrees: float = key(
        0.0, Number(0, 90), "radius over which each texel of a light is spread", "degrees"
    )


@dataclass(frozen=True)
class Output(Table):
    """What a run leaves behind."""

    dir: str = key("", String(), "folder of the results; empty: `<config stem>_out` beside the file")
    tonemap: str = key("gamma", Choice(*TONEMAPS), "tonemap of previews and metrics")
    spp: int | str = key(
        "auto",
        OrAuto(Integer(1, 1 << 20)),
        "samples of the judged rendering; auto: 256 to 768, until noise is below 48 dB",
        "per pixel",
    )
    report: bool = key(True, Boolean(), "write preview.png and report.html")
    full: bool = key(True, Boolean(), "write edited_full.exr, at the resolution of the input's file")
    format: str = key(
        "exr", Choice("exr", "hdr"), "file of the edited map: OpenEXR, or Radiance (.hdr), 8 bits a channel"
    )
    exposure: float = key(0.0, Number(-100, 100), "by how much the edited map is brightened at last", "stops")
    white_balance: float = key(
        0.0,
        KELVIN,
        "temperature of the light that becomes neutral in the edited map; 0: as it is",
        "kelvin",
    )
    temperature: float = key(
        0.0,
        KELVIN,
        "of the light in place of 6500 K, in all of the edited map: less is warmer; 0: as it is",
        "kelvin",
    )
    half: bool = key(
        False, Boolean(), "OpenEXR with 16 bits a channel; what is above 65504 is cut, with a warning"
    )
    scene: bool = key(True, Boolean(), "write edited.xml and edited.usda, which the edited map lights")

    def _check_together(self) -> None:
        if self.half and self.format != "exr":
            raise ConfigError('output.half: got true with output.format "hdr", expected "exr"')


@dataclass(frozen=True)
class Config(Table):
    """Everything a run depends on: ``Config(preset="draft", scene={"width": 64})``.

    Tables may be given as dicts. :func:`envedit.edit` takes nested dicts with the tables and keys of a TOML
    file, whose paths it resolves. Every key with its range and unit: docs/configuration.md.

    Raises
    ------
    ConfigError
        A key is unknown, or its value is of another type or out of its range; the message names it.
    """

    preset: str = key("standard", Choice(*presets.PRESETS), "named set of defaults")
    seed: int = key(0, Integer(0, 2**32 - 1), "base of every random number")
    variant: str = key(
        "llvm_ad_rgb",
        Choice("llvm_ad_rgb", "cuda_ad_rgb", "metal_ad_rgb"),
        "Mitsuba variant: by LLVM on the CPU, or on a GPU of NVIDIA, or of Apple (untried)",
    )
    input: Input = table_key(Input)
    scene: Scene = table_key(Scene)
    target: Target = table_key(Target)
    lights: Lights = table_key(Lights)
    representation: Representation = table_key(Representation, EDITED)
    fit: Fit = table_key(Fit, SIREN | EDITED)
    loss: Loss = table_key(Loss, ADAM_STEPS | EDITED)
    perceptual: Perceptual = table_key(Perceptual)
    solve: Solve = table_key(Solve, EDITED)
    optimizer: Optimizer = table_key(Optimizer, EDITED)
    renderer: Renderer = table_key(Renderer)
    output: Output = table_key(Output)

    def _name(self, key: str) -> str:
        return key

    @property
    def newton(self) -> bool:
        """Whether Gauss-Newton steps can solve it: layers, through a stored transport."""
        chosen = self.representation.kind, self.renderer.kind
        return chosen == ("layers", "transport") and self.optimizer.kind != "adam"

    @property
    def given_tables(self) -> dict[str, dict[str, Any]]:
        """What was given of each table: values by key."""
        return {name: getattr(self, name).given_values for name in FIELDS}

    @property
    def defaults(self) -> dict[str, dict[str, Any]]:
        """The preset's defaults of each table, for the representation and the target that there are."""
        return presets.defaults(self.preset, self.given_tables)

    def _check_together(self) -> None:
        """Put the preset's defaults in the place of what was not given, however the tables were made."""
        chosen = self.defaults
        for name in FIELDS:
            object.__setattr__(self, name, getattr(self, name).with_defaults(chosen.get(name, {})))
        if self.optimizer.kind == "gauss-newton" and not self.newton:
            raise ConfigError(
                'optimizer.kind: got "gauss-newton", expected adam or auto: it solves for layers '
                "(representation.kind) through a stored transport (renderer.kind)"
            )


Fields = dict[str, Field[Any]]
TOP: Fields = {f.name: f for f in fields(Config)}
"""Fields of the configuration by name: its keys outside of tables, and the tables."""
FIELDS: dict[str, Fields] = {
    name: {f.name: f for f in fields(top.metadata["table"])}
    for name, top in TOP.items()
    if "table" in top.metadata
}
"""Fields of each table by name."""


def _document(cls: type[Table], keys: Mapping[str, Field[Any]]) -> None:
    """Put the meaning of each key, which is written once, beside its default, into what help() shows."""
    lines = []
    for name, f in keys.items():
        unit = f", {f.metadata['unit']}" if f.metadata["unit"] else ""
        lines.append(f"{name} : {f.type}\n    {f.metadata['doc']}{unit}.")
    cls.__doc__ = f"{inspect.cleandoc(cls.__doc__ or '')}\n\nAttributes\n----------\n" + "\n".join(lines)


for _name, _fields in FIELDS.items():
    _document(TOP[_name].metadata["table"], _fields)
_document(Config, {name: f for name, f in TOP.items() if name not in FIELDS})
