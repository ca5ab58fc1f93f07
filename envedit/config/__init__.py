"""Configuration: TOML to frozen dataclasses, with presets, checks and errors that name the key."""

from envedit.config.input_schema import TARGET_KINDS
from envedit.config.schema import (
    Config,
    Fit,
    Input,
    Lights,
    Loss,
    Optimizer,
    Output,
    Renderer,
    Representation,
    Scene,
    Target,
)
from envedit.config.toml import from_dict, load, loads, quote, to_toml
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
    "Renderer",
    "Representation",
    "Scene",
    "Target",
    "from_dict",
    "load",
    "loads",
    "quote",
    "to_toml",
    "unused",
]
