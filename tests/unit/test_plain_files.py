"""History and metrics: read back with other readers, with values that are not finite."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from envedit.report import plain_files


def test_history_reads_back_with_holes_for_what_is_not_finite(tmp_path):
    rows = [
        {"iteration": 0, "loss": np.float32(0.1), "ssim": 1e-30},
        {"iteration": np.int64(1), "loss": np.nan, "l1": None},
        {"iteration": 2, "loss": np.inf, "ssim": 65504.0},
    ]
    plain_files.write_history(tmp_path / "history.csv", rows)
    with open(tmp_path / "history.csv", newline="") as file:
        read = list(csv.DictReader(file))
    assert list(read[0]) == ["iteration", "loss", "ssim", "l1"]
    assert [row["loss"] for row in read] == ["0.1", "", ""]
    assert [row["ssim"] for row in read] == ["1e-30", "", "65504.0"]
    assert [row["l1"] for row in read] == ["", "", ""]
    plain_files.write_history(tmp_path / "history.csv", [])
    assert (tmp_path / "history.csv").read_text() == "iteration\n"


def test_metrics_are_finite_or_null(tmp_path):
    metrics = {
        "render": {"psnr": np.float32(38.7), "ssim": np.nan, "lpips": None},
        "iterations": np.int32(7),
        "cached": np.bool_(True),
        "active_rows": (0, np.uint8(63)),
        "trace": np.array([1.0, np.inf], np.float32),
        "file": Path("a") / "ö.exr",
    }
    plain_files.write_json(tmp_path / "metrics.json", metrics)
    lost: list[str] = []
    plain_files.plain(metrics, "", lost)
    assert lost == ["render.ssim", "trace[1]"]

    def refuse(name):
        raise AssertionError(f"{name} in metrics.json")

    read = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=refuse)
    assert read["render"] == {"psnr": 38.7, "ssim": None, "lpips": None}
    assert read["iterations"] == 7 and read["cached"] is True and read["active_rows"] == [0, 63]
    assert read["trace"] == [1.0, None] and read["file"] == str(Path("a") / "ö.exr")
    assert list(read) == list(metrics)


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "metrics.json"
    plain_files.write_json(path, {"a": 1})
    with pytest.raises(TypeError, match=r"b\[1\].c: object cannot be written"):
        plain_files.write_json(path, {"b": [0, {"c": object()}]})
    assert json.loads(path.read_text()) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.json"]
