"""The configuration: defaults, overrides, refusals by name, and the way to TOML and back."""

import dataclasses
import math
import tomllib

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from envedit import config as cfg
from envedit.config import schema, toml
from envedit.core.errors import ConfigError
from tests.oracles.builders import refused

quick = settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.too_slow])

KINDS = ("layers", "siren", "pixels", "log-pixels")


# ---- defaults ----------------------------------------------------------------------------------------------
def test_an_empty_file_gives_the_defaults():
    config = cfg.loads("")
    assert config.preset == "standard" and config == dataclasses.replace(cfg.Config(), output=config.output)


@pytest.mark.parametrize(
    "tables", [f"[representation]\nkind = '{kind}'" for kind in KINDS[1:]] + ["[renderer]\nkind = 'path'"]
)
def test_gauss_newton_without_layers_or_a_transport_is_refused(tables):
    assert cfg.loads("[optimizer]\nkind = 'gauss-newton'").optimizer.kind == "gauss-newton"
    message = refused(tables + "\n[optimizer]\nkind = 'gauss-newton'")
    assert "optimizer.kind" in message and "expected adam or auto" in message
    for solver in ("auto", "adam"):
        assert cfg.loads(tables + f"\n[optimizer]\nkind = '{solver}'").optimizer.kind == solver
    assert "optimizer.kind" in refused(tables, "optimizer.kind=gauss-newton")
    assert "optimizer.kind" in refused(tables + "\n[optimizer]\nkind = 'newton'")


# ---- overrides ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("text, keys, value", [
    ("fit.epochs=10", ("fit", "epochs"), 10),
    ("seed = 3", ("seed",), 3),
    ("input.envmap=maps/a b.exr", ("input", "envmap"), "maps/a b.exr"),
    ('input.envmap="a=b"', ("input", "envmap"), "a=b"),
    ("loss.ssim=[1, 1e4]", ("loss", "ssim"), [1, 1e4]),
    ("renderer.spp=auto", ("renderer", "spp"), "auto"),
    ("output.report=false", ("output", "report"), False),
    ("output.dir=", ("output", "dir"), ""),
    ("scene.parameters.roughness=0.5", ("scene", "parameters", "roughness"), 0.5),
    ("fit.epochs=1\nseed=2", ("fit", "epochs"), "1\nseed=2"),
    ("seed=0x", ("seed",), "0x"),
])  # fmt: skip
def test_overrides_are_toml_or_bare_words(text, keys, value):
    assert toml.parse_override(text) == (keys, value)


@pytest.mark.parametrize("text", ["", "fit.epochs", "=3", "fit.=3", ".epochs=3", 3])
def test_an_override_without_key_or_value_is_refused(text):
    with pytest.raises(ConfigError, match="expected table.key=value"):
        toml.parse_override(text)


# ---- refusals ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("text, parts", [
    ("[fit]\nepoch = 3", ["a.toml", "[fit] has no key epoch", "did you mean epochs?"]),
    ("epochs = 3", ["unknown table or key epochs", "did you mean fit.epochs?"]),
    ("[ouput]\ndir = 'x'", ["unknown table or key ouput", "did you mean output?"]),
    ("[loss]\nrestart_period = 3", ["[loss] has no key", "did you mean fit.restart_period?"]),
    ("[fit]\nxyzzy = 3", ["[fit] has no key xyzzy", "known: epochs, lr"]),
    ("fit = 3", ["fit: got 3, expected a table"]),
    ("[seed]\na = 1", ["seed: got {'a': 1}, expected an integer"]),
    ('preset = "drift"', ["preset: got 'drift'", "did you mean draft?"]),
    ('[representation]\nkind = "layer"', ["representation.kind: got 'layer'", "did you mean layers?"]),
    ("[representation]\ncycles = 0", ["representation.cycles: got 0", "from 1 to 256"]),
    ('[fit]\nschedule = "cosin"', ["fit.schedule: got 'cosin'", "did you mean cosine?"]),
    ("[target]\nfile = 'b.exr'\nrotate_degrees = 5", ["a.toml", "target.file and target.rotate_degrees"]),
    ("[target]\nkind = 'image'", ["target.file", "expected the painted image"]),
    (
        "[target]\nkind = 'rendering'\nfile = ['a.png', 'b.png']\nmask = 'm.png'",
        ["target.mask: got 1 masks, expected 2"],
    ),
    ("[target]\nrest = 'stay'", ["target.rest: got 'stay'", "follow"]),
    *(
        (f"[perceptual]\n{key} = 'a.npz'", ["expected both or none"])
        for key in ("vgg", "dists", "backbone", "heads")
    ),
    (
        "[target]\nkind = 'strokes'\nmask = 'm.png'\n[[target.strokes]]\ntype = 'contrast'",
        ["target.mask: got '", "m.png', expected none"],
    ),
    ("[target]\nkind = 'imgae'", ["target.kind: got 'imgae'", "did you mean image?"]),
    ("[input]\nwidth = 128\nrows = [0, 64]", ["input.rows: got [0, 64], expected rows below 64"]),
    ("[loss]\nssim = 0\nimage_l1 = 0\nimage_l2 = 0", ["loss.ssim, loss.image_l1, loss.image_l2: got 0"]),
    ("[fit]\nlog_mse = 0\nlog_ssim = 0\nhdr = 0", ["got 0 for all"]),
    ("a = ", ["not TOML", "end of document"]),
    ("[fit]\nepochs = = 3", ["a.toml: not TOML", "at line 2, column 10"]),
    ("x = " + "[" * 5000, ["not TOML", "nested too deeply"]),
    ("seed = " + "9" * 5000, ["not TOML"]),
    ("seed = 0x" + "f" * 5000, ["seed: got a huge int"]),
])  # fmt: skip
def test_a_refusal_says_where_what_and_what_to_do(text, parts):
    message = refused(text)
    for part in parts:
        assert part in message


def test_keys_of_many_parts_are_refused_before_they_are_parsed():
    parts = "a." * 50_000  # tomllib would take minutes and gigabytes
    forms = (f"{parts}a = 1", f"[{parts}a]", f"x = {{ {parts}a = 1 }}", f"a . 'b c' . \"d\".{parts}a = 1")
    for text in forms:
        assert "a.toml: not TOML: a key of more than 100 parts (at line 2)" in refused(f"\n{text}")
    assert "did you mean" in refused("", f"input.envmp={{ {parts}a = 1 }}")  # not parsed: a string
    points = "[0.1, 0.25], " * 2000 + "[1.0, 1.0]"
    stroke = f"{{ type = 'light', points = [{points}], width = 0.1 }}"
    found = cfg.loads(f"[target]\nkind = 'strokes'\nstrokes = [{stroke}]").target.strokes
    assert len(found[0]["points"]) == 2001
    assert cfg.loads(f"# {'a word. ' * 300}\n[input]\nenvmap = 'a.b.c/../..' # {'.' * 500}").input.envmap


def test_a_refusal_is_short_and_names_the_override_it_came_from():
    long = "a" * 5000
    assert "known: preset" in refused(f"{long} = 1")
    assert "[fit] has no key 'aaa" in refused(f"[fit]\n{long} = 1")
    twice = refused(f"[{long}]\n[{long}]")
    assert "Cannot declare" in twice and twice.endswith("(at line 2, column 5002)")
    assert "seed" in refused(f"seed = '{long}'")
    assert refused("", "fit.epochs=-3").startswith("--set 'fit.epochs=-3': fit.epochs: got -3, expected")
    assert "did you mean epochs?" in refused("", "fit.epoch=3")
    assert "expected a table" in refused("", "fit=3")
    assert "preset: got 'fast'" in refused("", preset="fast")


def test_unreadable_files_are_refused(tmp_path):
    def message(path):
        with pytest.raises(ConfigError) as info:
            cfg.load(path)
        return str(info.value)

    assert "no such configuration file" in message(tmp_path / "none.toml")
    assert "a folder, expected a TOML file" in message(tmp_path)
    assert "cannot be read" in message("a\0b")
    (tmp_path / "latin.toml").write_bytes(b"seed = 1\n# caf\xe9\n")
    assert "latin.toml: not UTF-8 text at line 2" in message(tmp_path / "latin.toml")
    (tmp_path / "large.toml").write_bytes(b"#" * (2 << 20))
    assert "more than 1 MiB" in message(tmp_path / "large.toml")
    assert "cannot be read" in message(tmp_path / "latin.toml" / "below")


# ---- back to TOML ------------------------------------------------------------------------------------------


words = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=12)
numbers = st.floats(width=32, allow_nan=False, allow_infinity=False, allow_subnormal=False)

plain = st.recursive(
    words | numbers | st.booleans() | st.integers(-(2**63), 2**63 - 1),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)


@pytest.mark.slow
@quick
@given(st.dictionaries(words, plain, max_size=3))
@example({"most": 3.4028234663852886e38, "": 1e-5, "a b": -0.0, 'q"': "\x7f\"'\\\n\t\u2028é"})
def test_nested_values_are_written_and_come_back(table):
    """TOML's own parser reads what is written."""
    assert tomllib.loads(f"a = {cfg.quote(table)}")["a"] == table


# ---- junk --------------------------------------------------------------------------------------------------

known = [f.name for f in dataclasses.fields(cfg.Config)]
keys = st.sampled_from(known + [k for t in schema.FIELDS.values() for k in t]) | st.text(max_size=5)
scalars = [st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.dates()]
scalars += [st.binary(max_size=3), st.complex_numbers()]
odd = st.sampled_from(["auto", "sunsky", "layers", "image", "strokes", "\ud800", "a\0b", 10**4000, math.inf])
anything = st.recursive(
    st.one_of(*scalars, odd),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys | st.integers(), inner, max_size=4),
    max_leaves=8,
)
assignments = st.tuples(keys, st.sampled_from(["=", ".lr=", "."]), st.text(max_size=8)).map("".join)


def only_config_errors(call):
    """Junk is either understood, and then comes back equal, or refused with a message on one line."""
    try:
        config = call()
    except ConfigError as error:
        assert len(str(error).splitlines()) == 1 and len(str(error)) < 600
    else:
        assert cfg.loads(cfg.to_toml(config)) == config


@pytest.mark.slow
@quick
@given(st.dictionaries(keys, st.dictionaries(keys, anything, max_size=3) | anything, max_size=4) | anything)
def test_junk_tables_raise_nothing_but_config_errors(table):
    only_config_errors(lambda: cfg.from_dict(table))


@quick
@given(st.lists(assignments, max_size=2))
@example(["input.envmap=\udcff"])
def test_junk_overrides_raise_nothing_but_config_errors(overrides):
    only_config_errors(lambda: cfg.loads("", overrides=overrides))


def test_replacing_a_field_is_checked_as_well_and_numbers_are_normalised():
    with pytest.raises(ConfigError, match=r"fit\.epochs: got -1, expected an integer from 0"):
        dataclasses.replace(cfg.Fit(), epochs=-1)
    with pytest.raises(ConfigError, match=r"fit: got 3, expected a table"):
        cfg.Config(fit=3)
    config = cfg.from_dict({"fit": {"lr": np.float32(0.5), "epochs": np.int64(3)}, "loss": {"ssim": [1, 2]}})
    assert type(config.fit.lr) is float and type(config.fit.epochs) is int and config.loss.ssim == (1.0, 2.0)
    assert type(cfg.loads("[fit]\nlr = 1").fit.lr) is float
