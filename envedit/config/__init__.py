"""Configuration: TOML to frozen dataclasses, with presets, checks and errors that name the key."""

from envedit.config.input_schema import TARGET_KINDS
from envedit.config.reading import from_dict, load, loads, parse_override
from envedit.config.schema import (
    Config,
    Fit,
    Input,
    Lights,
    Loss,
    Optimizer,
    Output,
    Perceptual,
    Renderer,
    Representation,
    Scene,
    Target,
)
from envedit.config.toml import quote, to_toml
from envedit.config.unused import unused

__all__ = [
    "TARGET_KINDS",
    "Config",
    "Fit",
    "Input",
    "Lights",
    "Loss",
    "Optimizer",
    "Output",
    "Perceptual",
    "Renderer",
    "Representation",
    "Scene",
    "Target",
    "from_dict",
    "load",
    "loads",
    "parse_override",
    "quote",
    "to_toml",
    "unused",
]
