"""Where values come from: presets, precedence, targets and paths; from TOML as from Python."""

import itertools
from dataclasses import fields, replace

import pytest

from envedit import config as cfg
from envedit.config import presets
from envedit.core.errors import ConfigError


def test_the_paper_preset_spells_out_every_number_of_the_method():
    """A default that is changed later must not change the paper's recipe."""
    free = {"fit": {"cache"}, "representation": {"cycles"}, "loss": set()}
    free["optimizer"] = {"checkpoint_s", "start"}
    for table, left_out in free.items():
        keys = {f.name for f in fields(getattr(cfg.Config(), table))}
        assert set(presets.PRESETS["paper"][table]) == keys - left_out, table


def test_default_then_preset_then_file_then_override_key_by_key():
    assert cfg.loads("").fit.epochs == 1200
    assert cfg.loads('preset = "draft"').fit.epochs == 500
    assert cfg.loads('preset = "draft"\n[fit]\nepochs = 7').fit.epochs == 7
    assert cfg.loads('preset = "draft"\n[fit]\nepochs = 7', overrides=["fit.epochs=8"]).fit.epochs == 8
    assert cfg.loads("", overrides=["fit.epochs=8", "fit.epochs=9"]).fit.epochs == 9

    # And the argument before an override of the preset.
    assert cfg.loads('preset = "draft"', overrides=["preset=paper"]).preset == "paper"
    config = cfg.loads('preset = "draft"', preset="standard", overrides=["preset=paper"])
    assert config.preset == "standard" and config.fit.epochs == 1200
    config = cfg.loads("[scene.parameters]\na = 1\nb = true", overrides=["scene.parameters.a=glossy"])
    assert config.scene.parameters == {"a": "glossy", "b": True}


MANY = ("siren", "pixels", "log-pixels")


@pytest.mark.parametrize(("preset", "kind", "ssim", "iterations", "dists"), [
    ("standard", "layers", 0.1, 100, 0.0),
    ("draft", "layers", 0.1, 100, 0.0),
    ("standard", "siren", 1.0, "auto", "auto"),
    ("draft", "siren", 1.0, 150, "auto"),
    *(("standard", kind, 1.0, 600, 0.0) for kind in MANY[1:]),
    *(("draft", kind, 1.0, 150, 0.0) for kind in MANY[1:]),
    *(("paper", kind, (1.0, 1e4), 400, 0.6) for kind in ("layers", *MANY)),
])  # fmt: skip
def test_losses_and_length_suit_the_kind(preset, kind, ssim, iterations, dists):
    given = [
        cfg.loads(f'preset = "{preset}"\n[representation]\nkind = "{kind}"'),
        cfg.loads("", preset=preset, overrides=[f"representation.kind={kind}"]),
        cfg.from_dict({"representation": {"kind": kind}}, overrides=[f"preset={preset}"]),
    ]
    for config in given:
        assert config.representation.kind == kind
        assert (config.loss.ssim, config.optimizer.iterations) == (ssim, iterations)
        assert config.loss.dists == dists


def test_the_last_kind_counts_and_file_and_override_beat_its_defaults_key_by_key():
    text = '[representation]\nkind = "siren"'
    assert cfg.loads(text, overrides=["representation.kind=layers"]).optimizer.iterations == 100
    assert cfg.loads(text, overrides=["representation.kind=pixels"]).loss.ssim == 1.0
    assert cfg.loads("", preset="paper").representation.kind == "siren"
    text = 'preset = "draft"\n[representation]\nkind = "pixels"\n[optimizer]\niterations = 7'
    config = cfg.loads(text)
    assert (config.optimizer.iterations, config.loss.ssim) == (7, 1.0)
    config = cfg.loads(text, overrides=["optimizer.iterations=8", "loss.ssim=[1, 2]"])
    assert (config.optimizer.iterations, config.loss.ssim) == (8, (1, 2))
    # What neither the kind nor the file names is the preset's.
    assert config.input.width == 128 and config.scene.width == 64
    # A given key that has the value of another kind's default is kept.
    same = cfg.loads("[loss]\nssim = 0.1", overrides=["representation.kind=siren"])
    assert same.loss.ssim == 0.1 and same.optimizer.iterations == "auto"


def test_a_target_is_a_file_or_a_turn_and_the_last_one_given_counts():
    for config in (cfg.loads(""), cfg.loads("[target]\nfile = 'b.exr'")):
        assert config.target.rotate_degrees == "auto"
    assert cfg.Target().degrees == 60 and cfg.Target(rotate_degrees=5).degrees == 5
    file = cfg.Target(file="/b.exr", rotate_degrees=0)  # no turn, as in configurations of earlier versions
    assert (file.file, file.rotate_degrees) == ("/b.exr", 0)
    with pytest.raises(ConfigError, match=r"target.file and target.rotate_degrees: got both, expected one"):
        cfg.Target(file="/b.exr", rotate_degrees=5)
    with pytest.raises(ConfigError, match="got both"):
        replace(cfg.Target(rotate_degrees=5), file="/b.exr")
    painted = cfg.loads("[target]\nkind = 'image'\nfile = '/b.exr'\nrotate_degrees = 5")
    assert painted.target.file == "/b.exr" and painted.target.rotate_degrees == 5
    (said,) = cfg.unused(painted)
    assert said.startswith("target.rotate_degrees: no effect: needs target.kind")
    turned = cfg.loads("[target]\nfile = 'b.exr'", overrides=["target.rotate_degrees=5"]).target
    assert turned.file == "" and turned.rotate_degrees == 5
    for still in ("0", "auto"):
        same = cfg.loads("[target]\nfile = '/b.exr'", overrides=[f"target.rotate_degrees={still}"]).target
        assert same.file == "/b.exr"
    other = cfg.loads("[target]\nrotate_degrees = 5", base_dir="/d", overrides=["target.file=b.exr"]).target
    assert other.file == "/d/b.exr" and other.rotate_degrees == "auto"
    for kind in ("envmap", "image"):
        text = f"[target]\nkind = '{kind}'\nfile = 'b.exr'"
        cleared = cfg.loads(text, overrides=["target.kind=envmap", "target.file="]).target
        assert cleared.file == "" and cleared.rotate_degrees == "auto"


def test_paths_are_relative_to_the_file_and_names_that_are_no_paths_stay(tmp_path, here):
    folder = tmp_path / "project"
    folder.mkdir()
    text = "[input]\nenvmap = 'maps/sky.exr'\n[scene]\nfile = 'room.xml'\n"
    text += "[target]\nkind = 'image'\nfile = '/abs/t.png'\nmask = 'm.png'\n"
    (folder / "edit.v2.toml").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    config = cfg.load("project/edit.v2.toml", overrides=["target.mask=n.png"])
    assert config.input.envmap == str(folder / "maps/sky.exr")
    assert config.scene.file == str(folder / "room.xml") and config.target.file == "/abs/t.png"
    assert config.target.mask == str(folder / "n.png") and config.output.dir == str(folder / "edit.v2_out")
    config = cfg.loads("[scene]\nfile = 'mirror'", base_dir="/d")
    assert config.scene.file == "mirror" and config.input.envmap == "auto" and config.target.file == ""
    config = cfg.loads("[scene]\nfile = './mirror'\n[input]\nenvmap = './sunsky'", base_dir="/d")
    assert config.scene.file == "/d/mirror" and config.input.envmap == "/d/sunsky"


@pytest.mark.parametrize(
    "kind",
    ['kind = "image"\nfile = "p.png"', 'kind = "strokes"\nstrokes = [{type = "temperature", kelvin = 4000}]'],
)
def test_painted_targets_have_their_own_defaults(kind):
    assert cfg.loads("").loss.change == 0
    assert cfg.loads(f"[target]\n{kind}").loss.change > 0
    assert cfg.loads(f"[loss]\nchange = 0\n[target]\n{kind}").loss.change == 0
    rendered = cfg.loads('[target]\nkind = "rendering"\nfile = "p.png"')
    assert rendered.loss == cfg.loads("").loss
    paper = cfg.loads(f"[target]\n{kind}", preset="paper")
    assert paper.loss.change == 0 and paper.loss.luminance[0] < 1e-4


# ---- from Python ------------------------------------------------------------------------------------------

PRESETS = presets.PRESETS
STROKE = {"type": "shadow", "ellipse": [0.5, 0.5, 0.1, 0.1]}
TARGETS = {
    "turned": {},
    "other map": {"file": "/other.exr"},
    "image": {"kind": "image", "file": "/painted.png"},
    "strokes": {"kind": "strokes", "strokes": [STROKE]},
}
OUT = {"dir": "/out"}


@pytest.mark.parametrize(
    ("preset", "kind", "target"), [*itertools.product(PRESETS, ("layers", *MANY, ""), TARGETS)]
)
def test_tables_from_python_and_from_toml_are_equal(preset, kind, target):
    """A preset names the kind where none is given."""
    written = {"representation": {"kind": kind}} if kind else {}
    given = {"representation": cfg.Representation(kind)} if kind else {}
    made = cfg.Config(preset=preset, output=cfg.Output(**OUT), target=cfg.Target(**TARGETS[target]), **given)
    assert made == cfg.from_dict(written | {"preset": preset, "output": OUT, "target": TARGETS[target]})
    assert made == cfg.loads(cfg.to_toml(made), "/")
    assert made.representation.kind == (kind or ("siren" if preset == "paper" else "layers"))


def test_what_is_given_and_equal_to_the_default_goes_before_the_preset_too():
    assert cfg.Config(preset="draft", scene=cfg.Scene(width=128)).scene.width == 128
    assert cfg.Config(preset="draft", scene=cfg.Scene("sphere", 128)).scene.width == 128


@pytest.mark.parametrize(("before", "after"), [*itertools.permutations(PRESETS, 2)])
def test_replacing_the_preset_is_making_it_with_the_other_one(before, after):
    tables = {
        "scene": cfg.Scene(parameters={"roughness": 0.3}),
        "optimizer": cfg.Optimizer(lr=0.5),
        "seed": 3,
    }
    assert replace(cfg.Config(preset=before, **tables), preset=after) == cfg.Config(preset=after, **tables)


@pytest.mark.parametrize("preset", PRESETS)
def test_replacing_the_representation_brings_its_defaults_and_keeps_what_was_given(preset):
    tables = {"optimizer": cfg.Optimizer(iterations=7), "input": cfg.Input(width=64)}
    other = cfg.Representation("pixels")
    replaced = replace(cfg.Config(preset=preset, **tables), representation=other)
    assert replaced == cfg.Config(preset=preset, representation=other, **tables)
    assert replaced.optimizer.iterations == 7 and replaced.input.width == 64
    assert replaced.loss.ssim == (1.0 if preset != "paper" else (1.0, 1e4))
    read = cfg.loads(f'preset = "{preset}"\n[output]\ndir = "/out"\n[optimizer]\niterations = 7\n')
    replaced = replace(read, representation=cfg.Representation("pixels"))
    tables = {"optimizer": {"iterations": 7}, "representation": {"kind": "pixels"}}
    assert replaced == cfg.from_dict({"preset": preset, "output": OUT} | tables)


@pytest.mark.parametrize("preset", PRESETS)
def test_replacing_one_key_of_a_table_keeps_all_others(preset):
    made = cfg.Config(preset=preset, target=cfg.Target(**TARGETS["strokes"]))
    for name in ("input", "scene", "representation", "fit", "loss", "optimizer", "renderer", "output"):
        table = getattr(made, name)
        assert replace(made, **{name: replace(table)}) == made
    other = replace(made, optimizer=replace(made.optimizer, lr=0.25))
    assert replace(other, optimizer=made.optimizer) == made and other.optimizer.lr == 0.25
    assert other.optimizer.iterations == made.optimizer.iterations
