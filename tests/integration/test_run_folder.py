"""What a run writes beside the metrics: the map at its file's size, layers, and what no light can do."""

import json

import numpy as np
import OpenEXR
import pytest

from envedit.cli import run
from envedit.core import latlong
from envedit.core.errors import NumericalError
from envedit.export import file_resolution
from envedit.images import images
from tests.oracles.builders import BALL, LIGHT, SENSOR, write_scene
from tests.oracles.maps import flux
from tests.oracles.runs import TINY, as_toml, merged

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("isolated")]

WIDTH = 64
PIXELS = {"representation": {"kind": "pixels"}}


def source(rng):
    picture = (0.5 + 0.05 * rng.random((WIDTH // 2, WIDTH, 3))).astype(np.float32)
    picture[6, 20:22] = 400
    return picture


def carried_out(folder, picture, *arguments, **tables):
    """Run on the map with 16 working texels; returns the results' folder."""
    images.write_exr(folder / "map.exr", picture)
    write_scene(folder, SENSOR, BALL, LIGHT, name="scene.xml")
    files = {"input": {"envmap": "map.exr"}, "scene": {"file": "scene.xml"}}
    tiny = {name: keys for name, keys in TINY.items() if name != "representation"}
    (folder / "c.toml").write_text(as_toml(merged(tiny, files, tables)))
    assert run.main([str(folder / "c.toml"), "--quiet", *arguments]) == 0
    return folder / "c_out"


@pytest.mark.parametrize("kind", ["layers", "log-pixels"])
def test_the_edit_is_carried_to_the_size_of_the_file(kind, tmp_path, rng):
    picture = source(rng)
    out = carried_out(tmp_path, picture, representation={"kind": kind}, input={"width": 32})
    full, edited = (images.read(out / name)[0] for name in ("edited_full.exr", "edited.exr"))
    assert full.shape == picture.shape and edited.shape == (16, 32, 3)
    assert full[WIDTH // 4 :].tobytes() == picture[WIDTH // 4 :].tobytes()  # below the horizon
    assert not np.array_equal(full, picture)
    np.testing.assert_allclose(flux(full), flux(edited), rtol=0.02)
    channels = OpenEXR.File(str(out / "edited_layers.exr"), separate_channels=True).channels()
    planes = {name: channel.pixels for name, channel in channels.items()}
    for i, c in enumerate("RGB"):
        np.testing.assert_array_equal(planes[c], edited[..., i])
        np.testing.assert_allclose(planes[f"difference.{c}"], planes[c] - planes[f"initial.{c}"], atol=1e-5)
    np.testing.assert_array_equal(planes["influence.Y"], images.read(out / "influence.exr")[0][..., 0])


def test_a_sky_without_a_file_and_a_file_that_is_no_larger_have_no_full_map(tmp_path, rng):
    (tmp_path / "a").mkdir()
    out = carried_out(tmp_path / "a", latlong.resize(source(rng), 8, 16), **PIXELS)
    assert not (out / "edited_full.exr").exists() and (out / "edited_layers.exr").exists()
    (tmp_path / "b").mkdir()
    out = carried_out(tmp_path / "b", source(rng), "--set", "output.full=false", **PIXELS)
    assert not (out / "edited_full.exr").exists()


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (MemoryError(), "not enough memory"),
        (NumericalError("the carried map is not finite at row 3, column 4"), "row 3, column 4"),
        (None, "map.exr"),
    ],
)
def test_what_costs_the_full_map_costs_nothing_else(error, says, tmp_path, rng, monkeypatch, capsys):
    full = file_resolution.at_full_resolution

    def fails(*arguments):
        if error is not None:
            raise error
        (tmp_path / "map.exr").unlink()  # the file is gone by the end
        return full(*arguments)

    monkeypatch.setattr(file_resolution, "at_full_resolution", fails)
    out = carried_out(tmp_path, source(rng), **PIXELS)
    assert not (out / "edited_full.exr").exists() and (out / "metrics.json").exists()
    assert says in capsys.readouterr().err


def test_strokes_are_carried_out_and_what_cannot_be_had_is_told(tmp_path, rng, capsys):
    """A chequered patch in the middle of a matte ball: no light does that."""
    strokes = [
        {"type": kind, "rectangle": [x, y, x + 1, y + 1], "units": "pixels", "amount": 1.0}
        for x in range(10, 14) for y in range(7, 11) for kind in ("light" if (x + y) % 2 else "shadow",)
    ]  # fmt: skip
    out = carried_out(tmp_path, source(rng), target={"kind": "strokes", "strokes": strokes}, **PIXELS)
    found = json.loads((out / "metrics.json").read_text())
    assert set(found["painted"]) == {"towards", "elsewhere", "reachable"}
    assert 0 <= found["painted"]["reachable"] < 0.5
    assert "is feasible under any map" in capsys.readouterr().err
    assert found["envmap"] is None and found["timing"]["reach_s"] > 0
    assert any("is feasible" in line for line in found["choices"])
    assert images.read(out / "unreachable.png")[0].shape == (18, 24, 3)
    assert "What was painted" in (out / "report.html").read_text()
    wanted, initial = (images.read(out / f"render_{name}.exr")[0] for name in ("target", "initial"))
    np.testing.assert_allclose(wanted[8, 11:13], [initial[8, 11] + 1, 0 * initial[8, 12]], rtol=1e-5)
