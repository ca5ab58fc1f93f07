"""From a configuration, or a value, to TOML."""

from __future__ import annotations

import json
import re
from typing import Any

from envedit.config.schema import FIELDS, TOP, Config


def to_toml(config: Config) -> str:
    """Write a configuration, every key spelled out.

    A configuration that came from `load`, `loads` or `from_dict` loads back to an equal one from any folder,
    as its paths are absolute.
    """
    lines = [f"{key} = {quote(getattr(config, key))}" for key in TOP if key not in FIELDS]
    for name, keys in FIELDS.items():
        table = getattr(config, name)
        lines += ["", f"[{name}]", *(f"{key} = {quote(getattr(table, key))}" for key in keys)]
    return "\n".join(lines) + "\n"


def quote(value: Any) -> str:
    """Write a value as TOML on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON's escapes are TOML's, but for DEL, which only TOML requires to be escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        bare = {k: k if re.fullmatch(r"[A-Za-z0-9_-]+", k) else quote(k) for k in value}
        return f"{{ {', '.join(f'{bare[k]} = {quote(v)}' for k, v in value.items())} }}" if value else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(quote, value))}]"
    return repr(value)
