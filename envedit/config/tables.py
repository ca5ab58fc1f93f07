"""Tables of checked values: frozen dataclasses whose fields carry their check, meaning, unit and conditions.

Metadata of a field: ``check`` (:class:`.validators.Check`), ``doc`` (one line on its meaning), ``unit`` (""
for none) and ``when`` (:data:`When`); of a table inside a table ``table`` (its class) and ``when``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import Field, field, fields
from typing import Any, ClassVar, Self

from envedit.config.validators import Check, meant, named, show
from envedit.core.errors import ConfigError

When = dict[str, tuple[Any, ...]]
"""Where a key has a meaning: other keys, "table.key", with the values that they have there; () stands for any
but an empty one or 0. The key ``solver`` is not one of a file: the steps that are made, "gauss-newton" or
"adam"."""

PAINTED_KINDS = "image", "strokes"
"""Kinds of target that are painted on a rendering."""
PAINTED: When = {"target.kind": PAINTED_KINDS}
EDITED: When = {"target.kind": ("envmap", "rendering", "photo", "image", "strokes")}
LAYERS: When = {"representation.kind": ("layers",)}
SIREN: When = {"representation.kind": ("siren",)}
TRANSPORT: When = {"renderer.kind": ("transport",)}
ADAM_STEPS: When = {"solver": ("adam",)}


def key(default: Any, check: Check, doc: str, unit: str = "", when: When | None = None) -> Any:
    """Make a field of a :class:`Table`: its default, check, meaning in one line, unit and conditions."""
    metadata = {"check": check, "doc": doc, "unit": unit, "when": when or {}}
    if isinstance(default, dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


def table_key(table: type[Table], when: When | None = None) -> Any:
    """Make a field of a :class:`Table` that is a table itself; ``when`` is of all its keys."""
    return field(default_factory=table, metadata={"table": table, "when": when or {}})


class Table:
    """Checks and normalises every field on construction, so also in ``dataclasses.replace``."""

    # Names of the fields that were passed to the constructor; the others have their defaults, in whose place
    # a preset may put its own (:meth:`with_defaults`)
    given: ClassVar[frozenset[str]] = frozenset()

    def __new__(cls, *values: Any, **named: Any) -> Self:
        """Note which fields are given; ConfigError for one that there is not."""
        table, known = super().__new__(cls), [f.name for f in fields(cls)]  # type: ignore[arg-type]
        where = "" if cls.__name__ == "Config" else f"{cls.__name__.lower()}."
        if len(values) > len(known):
            raise ConfigError(f"{cls.__name__}: got {len(values)} values, expected at most {len(known)}")
        for name in (name for name in named if name not in known):
            raise ConfigError(f"{where}{name}: unknown key; {meant(name, known)}")
        if twice := [name for name in known[: len(values)] if name in named]:
            raise ConfigError(f"{where}{twice[0]}: got two values, expected one")
        object.__setattr__(table, "given", frozenset([*known[: len(values)], *named]))
        return table

    @property
    def given_values(self) -> dict[str, Any]:
        """The fields of :attr:`given` with their values, by name."""
        return {name: getattr(self, name) for name in sorted(self.given)}

    def with_defaults(self, values: Mapping[str, Any]) -> Self:
        """Return the table with other defaults; what was given stays."""
        table = type(self)(**{**values, **self.given_values})
        object.__setattr__(table, "given", self.given)
        return table

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]  # every table is a dataclass
            object.__setattr__(self, f.name, checked(f, self._name(f.name), getattr(self, f.name)))
        self._check_together()

    def _name(self, key: str) -> str:
        """Name a key in errors."""
        return f"{type(self).__name__.lower()}.{key}"

    def _check_together(self) -> None:
        """Check what depends on several keys of this table."""


def checked(f: Field[Any], name: str, value: Any) -> Any:
    """Check the value of a field, or of a table inside a table; raise ConfigError with the key's name."""
    if "table" in f.metadata:
        if isinstance(value, dict) and all(isinstance(key, str) for key in value):
            return f.metadata["table"](**value)
        if not isinstance(value, f.metadata["table"]):
            raise ConfigError(f"{name}: got {show(value)}, expected a table")
        return value
    return named(name, f.metadata["check"], value)
