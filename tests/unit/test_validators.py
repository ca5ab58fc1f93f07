"""Checks of configuration values: what is refused, how it is told, and what is normalised."""

import dataclasses

import numpy as np
import pytest

from envedit import config as cfg
from envedit.core.errors import ConfigError
from tests.oracles.builders import refused


@pytest.mark.parametrize("key, values", [
    ("seed", ["-1", "4294967296", "1.0", "true", '"1"']),
    ("variant", ['"scalar_rgb"', "1"]),
    ("input.width", ["2", "3", "257", "256.0", "true", "32768", "[256]"]),
    ("input.rows", ['"lower"', "[3]", "[5, 3]", "[-1, 3]", "[0, 1.5]", "{a = 1, b = 2}", "3"]),
    ("input.envmap", ['""', "3", '"a\\u0000"', "1979-05-27"]),
    ("input.elevation", ["-1", "91"]),
    ("scene.height", ["-1"]),
    ("scene.parameters", ["3", "{a = [1]}", "{a = nan}", "{a = {b = 1}}", "{a = 12:30:00}"]),
    ("target.strokes", ["[1]", "{}", "3"]),
    ("representation.kind", ["3", "[1]", '"network"']),
    ("representation.hidden", ["0", "-128", "true"]),
    ("representation.omega", ["0", "-30.0"]),
    ("fit.epochs", ["-1", "1.5", "nan", '"many"']),
    ("fit.lr", ["0", "-0.0", "-1e-4", "nan", "inf", "true", '"auto"', "1e-46", "1e39", "[1, 2]"]),
    ("optimizer.lr", ["0", '"Auto"', "nan", "-1"]),
    ("fit.awp_gamma", ["-0.1", "1.1"]),
    ("fit.cache", ["1", '"yes"']),
    ("loss.ssim", ["-1", "[1]", "[0, 1]", "[1, 0]", "[1, -1]", "[1, 2, 3]", '["a", 1]', "nan", "true"]),
    ("renderer.spp", ["0", '"Auto"', "1.5", "true"]),
    ("renderer.memory_gb", ["0", "-1", "nan"]),
    ("renderer.cache", ["1", '"yes"']),
    ("renderer.influence_threshold", ["-1e-3", "1.5", "nan", '"auto"']),
    ("output.tonemap", ['"filmic"', "1"]),
    ("output.report", ["0"]),
])  # fmt: skip
def test_values_out_of_type_or_range_are_refused_by_name(key, values):
    for value in values:
        message = refused(".".join(key.split(".")) + f" = {value}")
        assert message.startswith(f"a.toml: {key}: got ") and ", expected " in message
        assert message.count("expected") == 1


def test_replacing_a_field_is_checked_as_well_and_numbers_are_normalised():
    with pytest.raises(ConfigError, match=r"fit\.epochs: got -1, expected an integer from 0"):
        dataclasses.replace(cfg.Fit(), epochs=-1)
    with pytest.raises(ConfigError, match=r"fit: got 3, expected a table"):
        cfg.Config(fit=3)
    config = cfg.from_dict({"fit": {"lr": np.float32(0.5), "epochs": np.int64(3)}, "loss": {"ssim": [1, 2]}})
    assert type(config.fit.lr) is float and type(config.fit.epochs) is int and config.loss.ssim == (1.0, 2.0)
    assert type(cfg.loads("[fit]\nlr = 1").fit.lr) is float
