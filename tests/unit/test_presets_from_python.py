"""Presets act from Python as they do from TOML, and ``dataclasses.replace`` keeps what was given."""

import itertools
from dataclasses import replace

import pytest

from envedit import config
from envedit.config import Config, Input, Optimizer, Output, Representation, Scene, Target

PRESETS = config.presets.PRESETS
KINDS = ("layers", "siren", "pixels", "log-pixels")
STROKE = {"type": "shadow", "ellipse": [0.5, 0.5, 0.1, 0.1]}
TARGETS = {
    "turned": {},
    "other map": {"file": "/other.exr"},
    "image": {"kind": "image", "file": "/painted.png"},
    "strokes": {"kind": "strokes", "strokes": [STROKE]},
}
OUT = {"dir": "/out"}


@pytest.mark.parametrize(("preset", "kind", "target"), [*itertools.product(PRESETS, (*KINDS, ""), TARGETS)])
def test_tables_from_python_and_from_toml_are_equal(preset, kind, target):
    """A preset names the kind where none is given."""
    written = {"representation": {"kind": kind}} if kind else {}
    given = {"representation": Representation(kind)} if kind else {}
    made = Config(preset=preset, output=Output(**OUT), target=Target(**TARGETS[target]), **given)
    assert made == config.from_dict(written | {"preset": preset, "output": OUT, "target": TARGETS[target]})
    assert made == config.loads(config.to_toml(made), "/")
    assert made.representation.kind == (kind or ("siren" if preset == "paper" else "layers"))


def test_what_is_given_and_equal_to_the_default_goes_before_the_preset_too():
    assert Config(preset="draft", scene=Scene(width=128)).scene.width == 128
    assert Config(preset="draft", scene=Scene("sphere", 128)).scene.width == 128


@pytest.mark.parametrize(("before", "after"), [*itertools.permutations(PRESETS, 2)])
def test_replacing_the_preset_is_making_it_with_the_other_one(before, after):
    tables = {"scene": Scene(parameters={"roughness": 0.3}), "optimizer": Optimizer(lr=0.5), "seed": 3}
    assert replace(Config(preset=before, **tables), preset=after) == Config(preset=after, **tables)


@pytest.mark.parametrize("preset", PRESETS)
def test_replacing_the_representation_brings_its_defaults_and_keeps_what_was_given(preset):
    tables = {"optimizer": Optimizer(iterations=7), "input": Input(width=64)}
    other = Representation("pixels")
    replaced = replace(Config(preset=preset, **tables), representation=other)
    assert replaced == Config(preset=preset, representation=other, **tables)
    assert replaced.optimizer.iterations == 7 and replaced.input.width == 64
    assert replaced.loss.ssim == (1.0 if preset != "paper" else (1.0, 1e4))
    read = config.loads(f'preset = "{preset}"\n[output]\ndir = "/out"\n[optimizer]\niterations = 7\n')
    replaced = replace(read, representation=Representation("pixels"))
    tables = {"optimizer": {"iterations": 7}, "representation": {"kind": "pixels"}}
    assert replaced == config.from_dict({"preset": preset, "output": OUT} | tables)


@pytest.mark.parametrize("preset", PRESETS)
def test_replacing_one_key_of_a_table_keeps_all_others(preset):
    made = Config(preset=preset, target=Target(**TARGETS["strokes"]))
    for name in ("input", "scene", "representation", "fit", "loss", "optimizer", "renderer", "output"):
        table = getattr(made, name)
        assert replace(made, **{name: replace(table)}) == made
    other = replace(made, optimizer=replace(made.optimizer, lr=0.25))
    assert replace(other, optimizer=made.optimizer) == made and other.optimizer.lr == 0.25
    assert other.optimizer.iterations == made.optimizer.iterations
