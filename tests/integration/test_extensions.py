"""A package that adds a kind of representation, of renderer and of target (docs/extending.md has it)."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

import envedit
from envedit import config
from envedit.core import extensions
from envedit.core.errors import ConfigError
from tests.oracles.builders import sky

pytestmark = pytest.mark.usefixtures("isolated")

DOCS = Path(__file__).parents[2] / "docs" / "extending.md"
TABLES = {
    "preset": "draft",
    "input": {"width": 16},
    "scene": {"width": 16, "height": 16},
    "renderer": {"spp": 16},
    "target": {"spp": 64},
    "optimizer": {"iterations": 30, "lr": 0.1},
}


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install the package of the page, as pip would leave it."""
    text = DOCS.read_text()
    module, entry_points = (re.search(rf"```{kind}\n(.*?)```", text, re.S)[1] for kind in ("python", "toml"))
    (tmp_path / "one_colour.py").write_text(module)
    information = tmp_path / "one_colour-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: one-colour\nVersion: 1.0\n")
    groups = re.findall(r'\[project\.entry-points\."(.*)"\]\n(\w+) = "(.*)"', entry_points)
    assert len(groups) == 3
    (information / "entry_points.txt").write_text(
        "".join(f"[{group}]\n{name} = {value}\n" for group, name, value in groups)
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("one_colour", None)


@pytest.mark.slow
def test_a_package_adds_three_kinds(installed):
    envmap = sky(np.random.default_rng(0), 8, 16)
    kinds = {"representation": "one_colour", "renderer": "few_bounces", "target": "brighter"}
    tables = {table: {**TABLES.get(table, {}), "kind": kind} for table, kind in kinds.items()}
    result = envedit.edit({**TABLES, **tables}, envmap=envmap)
    assert not any("no effect" in warning for warning in result.warnings)
    ratio = result.envmap.sum(axis=(0, 1)) / envmap.sum(axis=(0, 1))
    # The target is lit twice as brightly; the map can only change by one factor a channel.
    np.testing.assert_allclose(ratio, 2, rtol=0.1)
    np.testing.assert_allclose(result.envmap, envmap * ratio, rtol=1e-3)


def test_a_module_that_cannot_be_imported_is_named(installed, tmp_path):
    (tmp_path / "one_colour.py").write_text("import a_module_that_is_missing\n")
    settings = config.from_dict({"representation": {"kind": "one_colour"}})
    assert settings.representation.kind == "one_colour"
    with pytest.raises(ConfigError, match="one_colour:Representation cannot be imported .*a_module_that"):
        extensions.load(extensions.REPRESENTATIONS, "one_colour")
