"""The configuration explains itself: JSON Schema, the page of all keys, and keys that change nothing."""

import contextlib
import dataclasses
import json
import math
import tomllib

import jsonschema
import pytest

from envedit import config
from envedit.cli import schema as command
from envedit.config.reference import json_schema, markdown
from envedit.config.schema import FIELDS, TOP
from envedit.config.validators import Choice, Integer, Number, WantedError
from envedit.core import shipped
from envedit.core.errors import ConfigError
from tests.oracles import ROOT


def accepts(schema, value):
    return jsonschema.Draft7Validator(schema).is_valid(value)


SCHEMA = json_schema()
CHECKS = {f"{table}.{key}": f.metadata["check"] for table, keys in FIELDS.items() for key, f in keys.items()}
CHECKS |= {key: f.metadata["check"] for key, f in TOP.items() if key not in FIELDS}


def edges(check):
    yield from (None, True, "", "auto", "all", "upper", "none such", [], {})
    yield from (-1, 0, 1, 2, 7, 0.5, 1e-3, -0.25, 1e30)
    yield from ([0], [0, 1], [1, 0], [3, 5.5], [0.5, 0.5], [-1, 2], [1, 2, 3], ["a"], ["a", "a"], [""], [[1]])
    yield from ({"a": 1}, {"a": "b", "c": True}, {"a": [1]}, 2000, 1999.5, 25000, 25001, "#ffd9a6", "#ffd9")
    while hasattr(check, "checks"):
        check = check.checks[0]
    if isinstance(check, Choice):
        yield from check.names
    if isinstance(check, Integer):
        yield from (check.low - 1, check.low, check.low + 1, check.high - 1, check.high, check.high + 1)
    if isinstance(check, Number):
        for end in (check.low, check.high):
            if math.isfinite(end):
                yield from (end, end + 1e-3, end - 1e-3)


LIGHTS = [{"azimuth": 1, "elevation": 2, "flux": [1, 2, 3]}]
SOFT = [LIGHTS[0] | more for more in ({"softness": 0.5}, {"softness": 0.5, "shape": "disc"}, {"softness": 0})]
# What JSON Schema cannot say of a value by itself: rows in order, and what is refused with the name of a key
# inside.
LOOSER = {"input.rows", "input.lights", "target.strokes"}


# Neither can it say which numbers single precision has, that a path has no NUL, and that 1.0 is no integer.
UNSAID = math.nan, math.inf, 1e-46, 1e39, "a\0", 1.0


@pytest.mark.parametrize("name", CHECKS)
def test_a_key_is_accepted_and_comes_back_or_is_refused_by_name_as_its_schema_says(name):
    check = CHECKS[name]
    table, _, key = name.rpartition(".")
    keys = SCHEMA["properties"][table]["properties"] if table else SCHEMA["properties"]
    jsonschema.Draft7Validator.check_schema(keys[key])
    taken = refused = 0
    for value in (*edges(check), *UNSAID):
        given = {table: {key: value}} if table else {key: value}
        try:
            check(value)
        except (WantedError, ConfigError):
            refused += 1
            unsaid = any(value is odd for odd in UNSAID)
            assert name in LOOSER or unsaid or not accepts(keys[key], value), value
            with pytest.raises(ConfigError) as error:
                config.from_dict(given)
            message = str(error.value)
            assert message.startswith(f"config.toml: {name}") and len(message.splitlines()) == 1
            assert name in LOOSER or message.count(", expected ") == 1, message
        else:
            taken += 1
            assert accepts(keys[key], value), value
            with contextlib.suppress(ConfigError):  # it may contradict the defaults of others
                made = config.from_dict(given, "/maps")
                assert config.loads(config.to_toml(made), "/elsewhere", "b.toml") == made
    assert taken and refused and str(check)
    assert accepts(keys[key], keys[key]["default"]) and keys[key]["description"]


def test_shipped_configurations_and_resolved_ones_fit_the_schema():
    files = [*shipped.folder().glob("**/*.toml")]
    assert len(files) > 5
    for file in files:
        assert accepts(SCHEMA, tomllib.loads(file.read_text())), file
    strokes = [{"type": "light", "polygon": [[0, 0], [1, 0], [0, 1]], "color": "#ffd9a6", "view": "left"}]
    lights = [{"light": 2, "azimuth": 3, "elevation": 4}, {"azimuth": 1, "elevation": 2, "flux": [1, 2, 3]}]
    made = {"target": {"kind": "strokes", "strokes": strokes}, "input": {"lights": lights, "rows": [2, 9]}}
    for preset in config.presets.PRESETS:
        assert accepts(SCHEMA, tomllib.loads(config.to_toml(config.from_dict(made, preset=preset))))


@pytest.mark.parametrize("table", [
    {"inptu": {}},
    {"input": {"widht": 64}},
    {"input": 3},
    {"input": {"lights": [{"azimuth": 3}]}},
    {"input": {"lights": [{"light": 9}]}},
    {"target": {"strokes": [{"amount": 1}]}},
    {"target": {"strokes": [{"type": "shado"}]}},
    {"target": {"strokes": [{"type": "light", "colour": [1, 1, 1]}]}},
    {"target": {"strokes": [{"type": "light", "polygon": [[0, 0], [1, 1]]}]}},
])  # fmt: skip
def test_the_schema_refuses_what_a_configuration_refuses(table):
    assert not accepts(SCHEMA, table)
    with pytest.raises(ConfigError):
        config.from_dict(table)


def test_the_page_is_what_is_generated(capsys):
    assert command.main(["--markdown"]) == 0
    printed = capsys.readouterr().out
    message = "run: envedit schema --markdown > docs/configuration.md"
    assert (ROOT / "docs" / "configuration.md").read_text() == printed == markdown(), message
    for keys in FIELDS.values():
        assert all(f"| `{key}` | " in printed for key in keys)
    assert command.main([]) == 0 and json.loads(capsys.readouterr().out) == SCHEMA


@pytest.mark.parametrize(("tables", "solver", "named"), [
    ({"representation": {"hidden": 64, "depth": 2}}, None, ["depth, representation.hidden: no effect"]),
    ({"representation": {"hidden": 64, "kind": "siren"}}, "adam", []),
    ({"representation": {"kind": "siren", "cycles": 3}}, "adam", ['= "layers", got "siren"']),
    ({"fit": {"lr": 1}}, None, ["fit.lr: no effect: needs representation.kind"]),
    ({"fit": {"restart_period": 7}, "representation": {"kind": "siren"}}, "adam", ["needs fit.schedule"]),
    ({"fit": {"awp_lr": 1, "awp_gamma": 0}, "representation": {"kind": "siren"}}, None, ["fit.awp_lr"]),
    ({"optimizer": {"lr": 0.1, "schedule": "constant"}, "loss": {"ssim": 1}}, "adam", []),
    (
        {
            "optimizer": {"lr": 0.1, "schedule": "constant"},
            "loss": {"ssim": 1},
            "renderer": {"refresh": 5},
        },
        "gauss-newton",
        ["loss.ssim, optimizer.lr, optimizer.schedule, renderer.refresh: no effect with"],
    ),
    ({"loss": {"ssim": 0.1}, "optimizer": {"lr": "auto"}}, "gauss-newton", []),  # the defaults
    ({"renderer": {"kind": "path", "memory_gb": 3}}, "adam", ['got "path"']),
    ({"input": {"envmap": "a.exr", "azimuth": 3}}, None, ["azimuth: no effect: needs input.envmap"]),
    ({"input": {"azimuth": 3}}, None, []),
    ({"input": {"lights": LIGHTS, "horizon": "keep", "rows": "upper"}}, None, []),  # they use the horizon
    ({"input": {"rows": "upper", "horizon": "keep"}}, None, ["horizon: no effect: needs input.rows"]),
    ({"input": {"lights": SOFT}}, None, ['lights[0].softness: no effect: needs shape other than "gaussian"']),
    ({"target": {"paint": 2}}, None, ["target.paint: no effect: needs target.kind"]),
    ({"target": {"tonemap": "gamma"}}, None, ["target.tonemap: no effect"]),
    ({"target": {"tonemap": "gamma", "file": "b.png"}}, None, []),  # which may be a picture
    ({"perceptual": {"vgg": "a", "dists": "b"}}, None, ["perceptual.dists, perceptual.vgg: no effect"]),
    ({"target": {"kind": "none"}, "optimizer": {"iterations": 3}}, None, ['other than "none"']),
    ({"target": {"kind": "none"}, "renderer": {"cache": False}, "output": {"spp": 3}}, None, []),
])  # fmt: skip
def test_keys_that_do_not_apply_are_named_with_the_reason(tables, solver, named):
    made = config.from_dict(tables, "/")
    said = config.unused(made, solver)
    assert len(said) == len(named) and all(map(lambda part, line: part in line, named, said)), said
    # A resolved configuration has every key, and is as quiet.
    assert config.unused(config.loads(config.to_toml(made)), solver) == said


@pytest.mark.parametrize("preset", config.presets.PRESETS)
@pytest.mark.parametrize("kind", ["layers", "siren", "pixels"])
def test_what_a_preset_gives_is_never_named(preset, kind):
    made = config.from_dict({"representation": {"kind": kind}}, preset=preset)
    for solver in ("adam", "gauss-newton"):
        assert config.unused(made, solver) == []
        assert config.unused(config.loads(config.to_toml(made)), solver) == []
    assert config.unused(dataclasses.replace(made, seed=3), "adam") == []
