"""The configuration as JSON Schema, by which editors complete and check TOML: ``envedit schema``."""

from __future__ import annotations

from dataclasses import MISSING, Field
from typing import Any

from envedit.config.schema import FIELDS, TOP
from envedit.config.unused import condition, conditions
from envedit.config.validators import Schema


def json_schema() -> Schema:
    """Return the configuration as JSON Schema, draft 7, which editors know.

    It accepts all that the configuration does. What depends on several keys, on the shape of a stroke or on
    single precision is left to the run.
    """
    properties: Schema = {}
    for name, top in TOP.items():
        if name not in FIELDS:
            properties[name] = _key(top, "")
            continue
        keys = {key: _key(f, condition(conditions(name, key))) for key, f in FIELDS[name].items()}
        about = (top.metadata["table"].__doc__ or "").partition("\n\n")[0]
        properties[name] = {"type": "object", "description": about, "properties": keys}
        properties[name]["additionalProperties"] = False
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Configuration of envedit",
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
    }


def _key(f: Field[Any], only: str) -> Schema:
    """Return the schema of a key: what it may be, its meaning and unit, and its default."""
    about, unit = f.metadata["doc"], f.metadata["unit"]
    about = f"{about} [{unit}]" if unit else about
    default = f.default_factory() if f.default_factory is not MISSING else f.default
    default = list(default) if isinstance(default, tuple) else default
    check: Schema = f.metadata["check"].schema()
    return {**check, "description": f"{about}; {only}" if only else about, "default": default}
