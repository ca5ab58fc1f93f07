"""The configuration: defaults, precedence, refusals by name, and the way back to TOML."""

import dataclasses
import math
import string
import tomllib

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from envedit import config as cfg
from envedit.errors import ConfigError

quick = settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.too_slow])


def refused(text, *overrides, **kwargs) -> str:
    with pytest.raises(ConfigError) as info:
        cfg.loads(text, name="a.toml", overrides=overrides, **kwargs)
    message = str(info.value)
    assert info.value.exit_code == 2
    assert len(message.splitlines()) == 1 and len(message) < 400
    return message


# ---- defaults and presets ----------------------------------------------------------------------------------


def test_an_empty_file_gives_the_defaults():
    config = cfg.loads("")
    assert config.preset == "standard" and config.seed == 0 and config.variant == "llvm_ad_rgb"
    assert config == dataclasses.replace(cfg.Config(), output=config.output)
    assert config.input == cfg.Input(envmap="sunsky", width=256, rows="upper")
    assert config.fit.lr == 2e-3 and config.renderer.spp == "auto" and config.loss.ssim == 1.0


def test_standard_is_the_defaults_and_the_presets_are_named():
    assert cfg.PRESETS["standard"] == {}
    assert cfg.preset_names() == ("draft", "standard", "paper")


@pytest.mark.parametrize("preset", cfg.preset_names())
def test_every_preset_takes_effect_key_by_key(preset):
    config = cfg.loads("", preset=preset)
    assert config.preset == preset
    for table, keys in cfg.PRESETS[preset].items():
        for key, value in keys.items():
            assert getattr(getattr(config, table), key) == value, (table, key)


def test_the_paper_preset_is_section_6():
    paper = cfg.loads("", preset="paper")
    assert paper.representation == cfg.Representation(kind="siren", hidden=256, depth=6, omega=30)
    fit = paper.fit
    assert (fit.epochs, fit.lr, fit.schedule, fit.restart_period) == (1500, 5e-5, "warm-restarts", 100)
    assert (fit.log_mse, fit.log_ssim, fit.hdr) == (0.85, 0.25, 1e-2)
    assert (fit.awp_gamma, fit.awp_lr) == (0.01, 1e-4)
    assert (paper.optimizer.lr, paper.optimizer.iterations) == (5e-6, 400)
    assert (paper.loss.ssim, paper.loss.dists) == ((1, 1e4), 0.6)
    assert paper.loss.luminance == paper.loss.l1 == (1e-4, 1e-8)
    assert (paper.input.width, paper.input.rows, paper.renderer.kind) == (256, "upper", "path")


def test_every_key_says_what_it_means():
    for f in dataclasses.fields(cfg.Fit):
        assert f.metadata["doc"] and f"{f.name} : " in cfg.Fit.__doc__
    assert "turbidity : float" in cfg.Input.__doc__ and "variant : str" in cfg.Config.__doc__


def test_tonemaps_are_those_of_the_image_module():
    from envedit import image

    assert set(cfg.TONEMAPS) == set(image.TONEMAPS)


# ---- precedence --------------------------------------------------------------------------------------------


def test_default_then_preset_then_file_then_override():
    assert cfg.loads("").fit.epochs == 600
    assert cfg.loads('preset = "draft"').fit.epochs == 150
    assert cfg.loads('preset = "draft"\n[fit]\nepochs = 7').fit.epochs == 7
    assert cfg.loads('preset = "draft"\n[fit]\nepochs = 7', overrides=["fit.epochs=8"]).fit.epochs == 8
    assert cfg.loads("", overrides=["fit.epochs=8", "fit.epochs=9"]).fit.epochs == 9


def test_the_preset_argument_beats_override_beats_file():
    assert cfg.loads('preset = "draft"', overrides=["preset=paper"]).preset == "paper"
    config = cfg.loads('preset = "draft"', preset="standard", overrides=["preset=paper"])
    assert config.preset == "standard" and config.fit.epochs == 600


@pytest.mark.parametrize(
    "text, keys, value",
    [
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
    ],
)
def test_overrides_are_toml_or_bare_words(text, keys, value):
    assert cfg.parse_override(text) == (keys, value)


@pytest.mark.parametrize("text", ["", "fit.epochs", "=3", "fit.=3", ".epochs=3", 3])
def test_an_override_without_key_or_value_is_refused(text):
    with pytest.raises(ConfigError, match="wanted table.key=value"):
        cfg.parse_override(text)


def test_scene_parameters_are_merged_key_by_key():
    config = cfg.loads("[scene.parameters]\na = 1\nb = true", overrides=["scene.parameters.a=glossy"])
    assert config.scene.parameters == {"a": "glossy", "b": True}


# ---- refusals ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text, parts",
    [
        ("[fit]\nepoch = 3", ["a.toml", "[fit] has no key epoch", "did you mean epochs?"]),
        ("epochs = 3", ["unknown table or key epochs", "did you mean fit.epochs?"]),
        ("[ouput]\ndir = 'x'", ["unknown table or key ouput", "did you mean output?"]),
        ("[loss]\nrestart_period = 3", ["[loss] has no key", "did you mean fit.restart_period?"]),
        ("[fit]\nxyzzy = 3", ["[fit] has no key xyzzy", "known: epochs, lr"]),
        ("fit = 3", ["fit: came 3, wanted a table"]),
        ("[seed]\na = 1", ["seed: came {'a': 1}, wanted an integer"]),
        ('preset = "drift"', ["preset: came 'drift'", "did you mean draft?"]),
        ('[representation]\nkind = "layers"', ["representation.kind", "comes later"]),
        ('[fit]\nschedule = "cosin"', ["fit.schedule: came 'cosin'", "did you mean cosine?"]),
        ("[target]\nfile = 'b.exr'\nrotate_degrees = 5", ["a.toml", "target.file and target.rotate_degrees"]),
        ("[target]\nkind = 'image'", ["target.file", "wanted the painted image"]),
        ("[target]\nkind = 'strokes'", ["target.strokes: came 0 strokes"]),
        ("[[target.strokes]]\ntype = 'fill'", ["target.strokes: came 1 strokes", 'kind = "envmap"']),
        ("[input]\nwidth = 128\nrows = [0, 64]", ["input.rows: came [0, 64], wanted rows below 64"]),
        ("[loss]\nssim = 0", ["loss.ssim, loss.image_l1: came 0 for both"]),
        ("[fit]\nlog_mse = 0\nlog_ssim = 0\nhdr = 0", ["came 0 for all"]),
        ("a = ", ["not TOML", "at line 1, column 5", "end of document"]),
        ("[fit]\nepochs = = 3", ["a.toml: not TOML", "at line 2, column 10"]),
        ("x = " + "[" * 5000, ["not TOML", "nested too deeply"]),
        ("seed = " + "9" * 5000, ["not TOML"]),
        ("seed = 0x" + "f" * 5000, ["seed: came a huge int"]),
    ],
)
def test_a_refusal_says_where_what_and_what_to_do(text, parts):
    message = refused(text)
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    "key, values",
    [
        ("seed", ["-1", "4294967296", "1.0", "true", '"1"']),
        ("variant", ['"scalar_rgb"', "1"]),
        ("input.width", ["2", "3", "257", "256.0", "true", "32768", "[256]"]),
        ("input.rows", ['"lower"', "[3]", "[5, 3]", "[-1, 3]", "[0, 1.5]", "{a = 1, b = 2}", "3"]),
        ("input.envmap", ['""', "3", '"a\\u0000"', "1979-05-27"]),
        ("input.elevation", ["-1", "91"]),
        ("scene.height", ["-1"]),
        ("scene.parameters", ["3", "{a = [1]}", "{a = nan}", "{a = {b = 1}}", "{a = 12:30:00}"]),
        ("target.strokes", ["[1]", "{}", "[{a = inf}]"]),
        ("representation.hidden", ["0", "-128", "true"]),
        ("representation.omega", ["0", "-30.0"]),
        ("fit.epochs", ["-1", "1.5", "nan", '"many"']),
        ("fit.lr", ["0", "-0.0", "-1e-4", "nan", "inf", "true", '"auto"', "1e-46", "1e39", "[1, 2]"]),
        ("fit.awp_gamma", ["-0.1", "1.1"]),
        ("fit.cache", ["1", '"yes"']),
        ("loss.ssim", ["-1", "[1]", "[0, 1]", "[1, 0]", "[1, -1]", "[1, 2, 3]", '["a", 1]', "nan", "true"]),
        ("renderer.spp", ["0", '"Auto"', "1.5", "true"]),
        ("renderer.memory_gb", ["0", "-1", "nan"]),
        ("output.tonemap", ['"reinhard"', "1"]),
        ("output.report", ["0"]),
    ],
)
def test_values_out_of_type_or_range_are_refused_by_name(key, values):
    for value in values:
        message = refused(".".join(key.split(".")) + f" = {value}")
        assert message.startswith(f"a.toml: {key}: came ") and ", wanted " in message
        assert message.count("wanted") == 1


def test_an_error_names_the_override_it_came_from():
    assert refused("", "fit.epochs=-3").startswith("--set 'fit.epochs=-3': fit.epochs: came -3, wanted")
    assert "did you mean epochs?" in refused("", "fit.epoch=3")
    assert "wanted a table" in refused("", "fit=3")
    assert "preset: came 'fast'" in refused("", preset="fast")


def test_replacing_a_field_is_checked_as_well():
    with pytest.raises(ConfigError, match=r"fit\.epochs: came -1, wanted an integer from 0"):
        dataclasses.replace(cfg.Fit(), epochs=-1)
    with pytest.raises(ConfigError, match=r"fit: came 3, wanted a table"):
        cfg.Config(fit=3)
    with pytest.raises(dataclasses.FrozenInstanceError):
        cfg.Fit().epochs = 3


def test_numbers_are_normalised():
    config = cfg.from_dict({"fit": {"lr": np.float32(0.5), "epochs": np.int64(3)}, "loss": {"ssim": [1, 2]}})
    assert type(config.fit.lr) is float and type(config.fit.epochs) is int
    assert config.loss.ssim == (1.0, 2.0)
    assert type(cfg.loads("[fit]\nlr = 1").fit.lr) is float


# ---- targets -----------------------------------------------------------------------------------------------


def test_a_target_file_means_no_rotation_and_the_last_source_wins():
    assert cfg.loads("").target.rotate_degrees == 60
    assert cfg.loads("[target]\nfile = 'b.exr'").target.rotate_degrees == 0
    turned = cfg.loads("[target]\nfile = 'b.exr'", overrides=["target.rotate_degrees=5"]).target
    assert turned.file == "" and turned.rotate_degrees == 5
    other = cfg.loads("[target]\nrotate_degrees = 5", base_dir="/d", overrides=["target.file=b.exr"]).target
    assert other.file == "/d/b.exr" and other.rotate_degrees == 0
    painted = cfg.loads("[target]\nkind = 'image'\nfile = '/b.exr'\nrotate_degrees = 5").target
    assert painted.file == "/b.exr"


# ---- files and paths ---------------------------------------------------------------------------------------


def test_paths_are_relative_to_the_file(tmp_path, monkeypatch):
    folder = tmp_path / "project"
    folder.mkdir()
    text = (
        "[input]\nenvmap = 'maps/sky.exr'\n[scene]\nfile = 'room.xml'\n"
        "[target]\nkind = 'image'\nfile = '/abs/t.png'\nmask = 'm.png'\n"
    )
    (folder / "edit.v2.toml").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    monkeypatch.chdir(tmp_path)
    config = cfg.load("project/edit.v2.toml", overrides=["target.mask=n.png"])
    assert config.input.envmap == str(folder / "maps/sky.exr")
    assert config.scene.file == str(folder / "room.xml")
    assert config.target.file == "/abs/t.png"
    assert config.target.mask == str(folder / "n.png")
    assert config.output.dir == str(folder / "edit.v2_out")


def test_names_that_are_no_paths_stay():
    config = cfg.loads("[scene]\nfile = 'mirror'", base_dir="/d")
    assert config.scene.file == "mirror" and config.input.envmap == "sunsky" and config.target.file == ""
    config = cfg.loads("[scene]\nfile = './mirror'\n[input]\nenvmap = './sunsky'", base_dir="/d")
    assert config.scene.file == "/d/mirror" and config.input.envmap == "/d/sunsky"


def test_unreadable_files_are_refused(tmp_path):
    def message(path):
        with pytest.raises(ConfigError) as info:
            cfg.load(path)
        return str(info.value)

    assert "no such configuration file" in message(tmp_path / "none.toml")
    assert "a folder, wanted a TOML file" in message(tmp_path)
    assert "cannot be read" in message("a\0b")
    (tmp_path / "latin.toml").write_bytes(b"seed = 1\n# caf\xe9\n")
    assert "latin.toml: not UTF-8 text at line 2" in message(tmp_path / "latin.toml")
    (tmp_path / "large.toml").write_bytes(b"#" * (2 << 20))
    assert "more than 1 MiB" in message(tmp_path / "large.toml")
    assert "cannot be read" in message(tmp_path / "latin.toml" / "below")


# ---- back to TOML ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", cfg.preset_names())
def test_presets_come_back_equal(preset):
    config = cfg.loads("", preset=preset)
    assert cfg.loads(cfg.to_toml(config), base_dir="/elsewhere", name="other.toml") == config


words = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=12)
numbers = st.floats(width=32, allow_nan=False, allow_infinity=False, allow_subnormal=False)
rates = st.floats(2.0**-100, 1e6)
weights = rates | st.just(0.0) | st.tuples(rates, rates).map(list)
plain = st.recursive(
    words | numbers | st.booleans() | st.integers(-(2**63), 2**63 - 1),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)


def given_keys(**keys):
    return st.fixed_dictionaries({}, optional=keys)


tables = given_keys(
    preset=st.sampled_from(cfg.preset_names()),
    seed=st.integers(0, 2**32 - 1),
    input=given_keys(
        envmap=words.filter(bool),
        rows=st.sampled_from(["upper", "all", [0, 3], [7, 31]]),
        repair=st.booleans(),
    ),
    scene=given_keys(
        file=words.filter(bool),
        parameters=st.dictionaries(words, words | numbers | st.booleans() | st.integers(-9, 9), max_size=3),
    ),
    target=given_keys(file=words, mask=words, spp=st.integers(1, 4096))
    | given_keys(rotate_degrees=st.floats(-360, 360, allow_subnormal=False, width=32))
    | st.fixed_dictionaries(
        {
            "kind": st.just("strokes"),
            "strokes": st.lists(st.dictionaries(words, plain), min_size=1, max_size=3),
        }
    ),
    loss=given_keys(ssim=rates | st.tuples(rates, rates), luminance=weights, tv=weights),
    optimizer=given_keys(lr=rates, iterations=st.integers(0, 10**7)),
    renderer=given_keys(spp=st.integers(1, 512) | st.just("auto"), memory_gb=rates | st.just("auto")),
    output=given_keys(dir=words, tonemap=st.sampled_from(cfg.TONEMAPS)),
)


@quick
@given(tables)
@example({"scene": {"parameters": {"most": 3.4028234663852886e38}}})
@example({"input": {"envmap": "\x7f\"'\\\n\t\u2028é"}})
@example({"scene": {"parameters": {"": 1e-5, "a b": -0.0, 'q"': 1e22}}})
def test_any_configuration_comes_back_equal(table):
    config = cfg.from_dict(table, base_dir="/maps", name="a.toml")
    text = cfg.to_toml(config)
    assert tomllib.loads(text)["seed"] == config.seed
    assert cfg.loads(text, base_dir="/elsewhere", name="b.toml") == config


# ---- junk --------------------------------------------------------------------------------------------------

known = [f.name for f in dataclasses.fields(cfg.Config)]
keys = st.sampled_from(known + [k for t in cfg._TABLES.values() for k in t]) | st.text(max_size=5)
anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=3)
    | st.dates()
    | st.complex_numbers()
    | st.sampled_from(["auto", "sunsky", "layers", "image", "strokes", "\ud800", "a\0b", 10**4000, math.inf]),
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


@quick
@given(st.dictionaries(keys, st.dictionaries(keys, anything, max_size=3) | anything, max_size=4) | anything)
def test_junk_tables_raise_nothing_but_config_errors(table):
    only_config_errors(lambda: cfg.from_dict(table))


@quick
@given(st.sampled_from(list(cfg._TABLES)), st.data())
def test_junk_values_raise_nothing_but_config_errors(table, data):
    key = data.draw(st.sampled_from(list(cfg._TABLES[table])))
    only_config_errors(lambda: cfg.from_dict({table: {key: data.draw(anything)}}))


@quick
@given(st.text(string.printable, max_size=60) | st.text(max_size=20))
def test_junk_text_raises_nothing_but_config_errors(text):
    only_config_errors(lambda: cfg.loads(text))


@quick
@given(st.lists(assignments, max_size=2))
@example(["input.envmap=\udcff"])
def test_junk_overrides_raise_nothing_but_config_errors(overrides):
    only_config_errors(lambda: cfg.loads("", overrides=overrides))


@quick
@given(st.binary(max_size=40))
def test_junk_files_raise_nothing_but_config_errors(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "junk.toml"
    path.write_bytes(data)
    only_config_errors(lambda: cfg.load(path))
