"""The command line of the fit: what it writes is what the network makes of the rows that were asked for."""

import json

import numpy as np
import pytest

from envedit import config
from envedit.cli import fit as fit_command
from envedit.core.array_cache import cache_folder
from envedit.images import images
from envedit.losses import metrics
from envedit.representations.siren import fit
from tests.oracles.builders import sky

SMALL = ["input.width=16", "representation.hidden=10", "representation.depth=1", "fit.epochs=4"]


pytestmark = pytest.mark.usefixtures("isolated")


def call(path, out, *overrides):
    arguments = [argument for one in (*SMALL, *overrides) for argument in ("--set", one)]
    return fit_command.main([str(path), "--out", str(out), *arguments])


@pytest.mark.parametrize("coordinates", ["sphere", "plane"])
@pytest.mark.parametrize(("rows", "first", "last"), [("upper", 0, 3), ("[2,6]", 2, 6)])
def test_the_fit_of_the_rows_is_written_and_measured(coordinates, rows, first, last, tmp_path, rng, capsys):
    picture = sky(rng)
    images.write_exr(tmp_path / "map.exr", picture)
    given = f"input.rows={rows}", f"representation.coordinates={coordinates}"
    assert call(tmp_path / "map.exr", tmp_path / "out", *given) == 0
    assert "log-PSNR" in capsys.readouterr().out
    crop = picture[first : last + 1]
    network = config.Representation(hidden=10, depth=1, coordinates=coordinates)
    expected = fit.fit(crop, network, config.Fit(epochs=4), 0, (first, 8), folder=cache_folder("fits"))
    assert expected.cached  # the command made this very fit
    written = images.read(tmp_path / "out" / "fitted.exr")[0]
    assert written.shape == crop.shape
    numbers = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert numbers["log_psnr"] == expected.log_psnr == pytest.approx(metrics.log_psnr(written, crop))
    assert numbers["peak_ratio"] == expected.peak_ratio == pytest.approx(metrics.peak_ratio(written, crop))
    assert numbers["mean_luminance_ratio"] == pytest.approx(metrics.mean_luminance_ratio(written, crop))
    assert numbers["epochs"] == 4 and numbers["cached"] is False

    assert call(tmp_path / "map.exr", tmp_path / "again", *given) == 0
    assert json.loads((tmp_path / "again" / "fit.json").read_text())["cached"] is True
    assert "kept from an earlier run" in capsys.readouterr().out
    again = images.read(tmp_path / "again" / "fitted.exr")[0]
    assert again.tobytes() == written.tobytes()


def test_the_map_is_not_overwritten(tmp_path, rng, capsys):
    images.write_exr(tmp_path / "fitted.exr", sky(rng))  # somebody's map by that name
    before = (tmp_path / "fitted.exr").read_bytes()
    assert call(tmp_path / "fitted.exr", tmp_path) == 3 and "another folder" in capsys.readouterr().err
    assert (tmp_path / "fitted.exr").read_bytes() == before


def test_the_map_of_the_command_is_fitted_whatever_set_says(tmp_path, rng, capsys):
    images.write_exr(tmp_path / "map.exr", sky(rng))
    assert call(tmp_path / "map.exr", tmp_path / "out") == 0
    other = f"input.envmap={config.quote(str(tmp_path / 'none.exr'))}"
    assert call(tmp_path / "map.exr", tmp_path / "again", other) == 0
    assert "kept from an earlier run" in capsys.readouterr().out


def test_a_map_that_is_not_there_is_an_error_in_one_line(tmp_path, capsys):
    assert call(tmp_path / "none.exr", tmp_path / "out") != 0
    error = capsys.readouterr().err
    assert error.startswith("envedit: ") and "none.exr" in error and len(error.splitlines()) == 1


def test_a_black_map_has_no_peak_to_compare(tmp_path, capsys):
    images.write_exr(tmp_path / "map.exr", np.zeros((8, 16, 3), np.float32))
    assert call(tmp_path / "map.exr", tmp_path / "out") == 0
    assert "undefined" in capsys.readouterr().out
    assert json.loads((tmp_path / "out" / "fit.json").read_text())["peak_ratio"] is None
