"""Keys that were given and have no meaning in the company of the others, so that a run can name them."""

from __future__ import annotations

from typing import Any

from envedit.config.schema import FIELDS, TOP, Config
from envedit.config.tables import When
from envedit.config.toml import quote
from envedit.config.validators import Choice, String


def unused(config: Config, solver: str | None = None) -> list[str]:
    """Name the keys that were given, differ from their default, and change nothing: a sentence each reason.

    A key that has its default's value is not named: a resolved configuration, which has every key, is as
    quiet as the one that it came from. Neither is what is switched off. ``solver`` is what makes the steps,
    "gauss-newton" or "adam"; None: not known, and not looked at.
    """
    defaults = config.defaults
    found: dict[str, list[str]] = {}
    for name, given in config.given_tables.items():
        default = type(getattr(config, name))(**defaults.get(name, {}))
        for key, value in given.items():
            if value is False or value == getattr(default, key):
                continue
            if reason := _reason(config, conditions(name, key), solver):
                found.setdefault(reason, []).append(f"{name}.{key}")
    counting = set()
    if config.input.lights:  # they are placed by the horizon whatever the representation is
        counting.add("input.horizon")
    if config.target.kind == "envmap" and config.target.file:  # which may be a picture of the scene
        counting.add("target.tonemap")
    found = {reason: [key for key in keys if key not in counting] for reason, keys in found.items()}
    if soft := _soft_gaussians(config):
        found['no effect: needs shape other than "gaussian"'] = soft
    return [f"{', '.join(keys)}: {reason}" for reason, keys in found.items() if keys]


def _soft_gaussians(config: Config) -> list[str]:
    """Name the ``softness`` of added lights that are Gaussian, whose border is always the same."""
    return [
        f"input.lights[{i}].softness"
        for i, light in enumerate(config.input.lights)
        if light.get("softness") and light.get("shape", "gaussian") == "gaussian"
    ]


def _reason(config: Config, when: When, solver: str | None) -> str:
    """Say why a key has no meaning; "" if it has one."""
    for other, values in when.items():
        if other == "solver":
            if solver is not None and solver not in values:
                return 'no effect with Gauss-Newton; needs [optimizer] kind = "adam"'
            continue
        table, _, key = other.partition(".")
        value = getattr(getattr(config, table), key)
        if value in values if values else value:
            continue
        check = FIELDS[table][key].metadata["check"]
        if isinstance(check, Choice) and value not in check.names:  # the kind of an installed package
            continue
        expected = _values(other, values)
        sign = "" if not values or expected.startswith("other than ") else "= "
        return f"no effect: needs {other} {sign}{expected}, got {quote(value)}"
    return ""


def _values(other: str, values: tuple[Any, ...]) -> str:
    """Write the values that a key has, or the only one that it has not."""
    table, _, key = other.partition(".")
    check = FIELDS[table][key].metadata["check"]
    if not values:
        return "given" if isinstance(check, String) else "not 0"
    names = check.names if isinstance(check, Choice) else ()
    rest = [name for name in names if name not in values]
    return f"other than {quote(rest[0])}" if len(rest) == 1 < len(values) else " or ".join(map(quote, values))


def condition(when: When) -> str:
    """Say where a key has a meaning; "" for everywhere."""
    parts = []
    for other, values in when.items():
        if other == "solver":
            parts.append("the steps are Adam's")
        else:
            parts.append(f"`{other}` is {_values(other, values)}")
    return f"only where {' and '.join(parts)}" if parts else ""


def conditions(table: str, key: str) -> When:
    """Return where a key of a table has a meaning: what is said of the table and of the key."""
    return {**TOP[table].metadata["when"], **FIELDS[table][key].metadata["when"]}
