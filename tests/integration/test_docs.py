"""The example of the documentation runs."""

import runpy

import numpy as np
import pytest

from tests.oracles import ROOT

DOCS = ROOT / "docs"


@pytest.mark.slow
def test_painting_in_python(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = runpy.run_path(str(DOCS / "paint_in_python.py"))
    result, asked = found["result"], found["asked"]
    assert asked["towards"] > 0.2 and asked["elsewhere"] < 0.03 and 0.5 < asked["reachable"] <= 1
    assert result.envmap.shape == found["sky"].shape and np.isfinite(result.envmap).all()
    assert "is feasible" in capsys.readouterr().out
