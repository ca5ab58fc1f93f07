"""Where values come from: presets, precedence, targets and paths."""

import dataclasses

import pytest

from envedit import config as cfg
from envedit import sources

# ---- presets -----------------------------------------------------------------------------------------------


def test_standard_is_the_defaults_and_the_presets_are_named():
    assert sources.PRESETS["standard"] == {}
    assert cfg.preset_names() == ("draft", "standard", "paper")


@pytest.mark.parametrize("preset", cfg.preset_names())
def test_every_preset_takes_effect_key_by_key(preset):
    config = cfg.loads("", preset=preset)
    assert config.preset == preset and (config.optimizer.lr == "auto") == (preset != "paper")
    for table, keys in sources.PRESETS[preset].items():
        for key, value in keys.items():
            assert getattr(getattr(config, table), key) == value, (table, key)


def test_the_paper_preset_is_section_6():
    paper = cfg.loads("", preset="paper")
    assert paper.representation == cfg.Representation("siren", 256, 6, 30.0, coordinates="plane")
    fit = paper.fit
    assert (fit.epochs, fit.lr, fit.schedule, fit.restart_period) == (1500, 5e-5, "warm-restarts", 100)
    assert (fit.log_mse, fit.log_ssim, fit.hdr) == (0.85, 0.25, 1e-2)
    assert (fit.awp_gamma, fit.awp_lr, fit.awp_every, fit.awp_until) == (0.01, 1e-4, 1, 1)
    assert (fit.beta2, fit.stride, fit.headroom, fit.light) == (0.999, 1, 0, 0)
    assert (paper.optimizer.lr, paper.optimizer.iterations) == (5e-6, 400)
    assert (paper.loss.ssim, paper.loss.dists) == ((1, 1e4), 0.6)
    assert paper.loss.luminance == paper.loss.l1 == (1e-4, 1e-8)
    assert (paper.input.width, paper.input.rows, paper.renderer.kind) == (256, "upper", "path")


def test_the_paper_preset_spells_out_every_number_of_the_method():
    """A default that is changed later must not change the paper's recipe."""
    free = {"fit": {"cache"}, "optimizer": {"checkpoint_s"}, "representation": set(), "loss": set()}
    for table, left_out in free.items():
        keys = {f.name for f in dataclasses.fields(getattr(cfg.Config(), table))}
        assert set(sources.PRESETS["paper"][table]) == keys - left_out, table


# ---- precedence --------------------------------------------------------------------------------------------


def test_default_then_preset_then_file_then_override():
    assert cfg.loads("").fit.epochs == 1200
    assert cfg.loads('preset = "draft"').fit.epochs == 500
    assert cfg.loads('preset = "draft"\n[fit]\nepochs = 7').fit.epochs == 7
    assert cfg.loads('preset = "draft"\n[fit]\nepochs = 7', overrides=["fit.epochs=8"]).fit.epochs == 8
    assert cfg.loads("", overrides=["fit.epochs=8", "fit.epochs=9"]).fit.epochs == 9


def test_the_preset_argument_beats_override_beats_file():
    assert cfg.loads('preset = "draft"', overrides=["preset=paper"]).preset == "paper"
    config = cfg.loads('preset = "draft"', preset="standard", overrides=["preset=paper"])
    assert config.preset == "standard" and config.fit.epochs == 1200


def test_scene_parameters_are_merged_key_by_key():
    config = cfg.loads("[scene.parameters]\na = 1\nb = true", overrides=["scene.parameters.a=glossy"])
    assert config.scene.parameters == {"a": "glossy", "b": True}


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
