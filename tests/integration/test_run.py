"""The command line on small runs: what it leaves, what it says, and how it stops and continues."""

import contextlib
import hashlib
import io
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from envedit import config, pipeline
from envedit.cli.progress import Progress
from envedit.core.color import tonemap
from envedit.images import images
from envedit.losses.perceptual import installed
from envedit.solve import adam_loop
from envedit.transport.light_transport import LightTransport
from tests.oracles import ROOT
from tests.oracles.builders import read_png, sky
from tests.oracles.runs import (
    FILES,
    INFLUENCE,
    call,
    changed,
    content,
    measured,
    names,
    no_constant,
    numbers,
    pixels,
    rows_of,
    small_world,
    world,
)

pytestmark = pytest.mark.usefixtures("isolated")

PIXELS = {"representation": {"kind": "pixels"}}
"""What is edited quickest."""


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Return (configuration, output folder, stdout, stderr) of one finished run."""
    folder = tmp_path_factory.mktemp("done")
    network = {"kind": "siren", "hidden": 16, "depth": 1}
    turned = {"rotate_degrees": 90.0}
    path = world(folder, np.random.default_rng(0), representation=network, target=turned)
    out, err = io.StringIO(), io.StringIO()
    with small_world(folder / "cache"), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        assert call(path) == 0
    return path, folder / "c_out", out.getvalue(), err.getvalue()


# ---- what a run leaves -----------------------------------------------------------------------------------


def test_exactly_the_promised_files_beside_the_configuration(done):
    _, folder, out, err = done
    assert names(folder) == FILES | INFLUENCE
    assert all(line in out.splitlines() for line in measured(folder)["choices"])
    assert str(folder) in out and re.search(r"rendering [\d.]+ -> [\d.]+ dB, map [\d.]+ -> [\d.]+ dB", out)
    assert "editing" in err.splitlines() and "editing" not in out.splitlines()


def test_pictures_and_metrics_are_finite(done):
    _, folder, _, _ = done
    for path in folder.glob("*.exr"):
        expected = (18, 24) if path.name.startswith("render") else (8, 16)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: channel.pixels.copy() for name, channel in file.channels().items()}
        for name, plane in planes.items():
            assert plane.dtype == np.float32 and plane.shape == expected
            assert np.isfinite(plane).all() and (name.startswith("difference") or (plane >= 0).all())
    found = measured(folder)
    assert found["iterations"] == 4 and found["non_finite_steps"] == 0 and found["active_rows"] == [0, 3]
    assert found["fit"]["epochs"] == 4 and found["fit"]["cached"] is False
    assert all(math.isfinite(number) for number in numbers(found))
    traced, times = found["transport"], found["timing"]
    # At least the packed entries, 16 bytes each, in both directions.
    assert traced["memory_bytes"] >= 32 * traced["entries"] > 0 and traced["cached"] is False
    assert 0 <= traced["depth_error"] < 0.1 and 0 < traced["predicted_error"] < 1
    parts = [value for key, value in times.items() if key not in ("total_s", "per_iteration_ms")]
    assert min(parts) >= 0 and times["total_s"] >= 0.99 * max(parts)


def test_metrics_are_those_of_the_written_pictures(done):
    """Against the definition, from the files: mean squared error of clip(E, 0, 1)^(1/2.2).

    Of the map on its active rows, against the true one: 90 degrees are a quarter of the columns, so that
    turning is exact whatever its sense.
    """
    path, folder, _, _ = done
    found = measured(folder)

    def error(a, b):
        shown = [np.clip(np.float64(x), 0, 1) ** (1 / 2.2) for x in (a, b)]
        return np.mean((shown[0] - shown[1]) ** 2)

    target = pixels(folder / "render_target.exr")
    for name, key in (("render_edited.exr", "render"), ("render_initial.exr", "initial")):
        mse = error(pixels(folder / name), target)
        assert found[key]["mse"] == pytest.approx(mse, rel=1e-4)
        assert found[key]["psnr"] == pytest.approx(-10 * math.log10(mse), abs=1e-3)
    start, edited = pixels(path.parent / "map.exr")[:4], pixels(folder / "edited.exr")[:4]
    errors = [error(edited, np.roll(start, columns, axis=1)) for columns in (4, -4)]
    assert any(found["envmap"]["mse"] == pytest.approx(mse, rel=1e-3) for mse in errors)


def test_the_resolved_configuration_loads_back_to_the_same_one(done):
    path, folder, _, _ = done
    assert config.load(folder / "config.toml") == installed.settled(config.load(path))


def test_the_manifest_names_inputs_and_seed(done):
    path, folder, _, _ = done
    found = json.loads((folder / "manifest.json").read_text(), parse_constant=no_constant)
    for role, name in (("envmap", "map.exr"), ("scene", "scene.xml")):
        given = found["inputs"][role]
        assert given["path"] == str(path.parent / name)
        assert given["sha256"] == hashlib.sha256((path.parent / name).read_bytes()).hexdigest()
    assert found["seeds"] == {"seed": 0} and found["variant"] == "llvm_ad_rgb"


def test_preview_and_report_are_whole(done):
    _, folder, _, _ = done
    picture = read_png(folder / "preview.png")
    assert picture.ndim == 3 and picture.std() > 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.rstrip().endswith("</html>") and page.count("data:image/png;base64,") >= 7
    assert "What this view determines" in page
    assert page.count("<figure>") == page.count("</figure>") and "<svg" in page
    assert f"{measured(folder)['render']['psnr']:.4g}"[:4] in page
    assert not re.search(r'(src|href)\s*=\s*"https?:', page)  # opens offline


# ---- what is computed ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_judged_rendering_is_what_mitsuba_makes_of_the_written_file(tmp_path, rng, monkeypatch):
    """The transport is made wrong by a factor; the picture that is judged does not know it.

    Mitsuba reads edited.exr by itself; pictures of 1024 and 4096 samples a pixel agree within their noise.
    """
    apply = LightTransport.apply
    monkeypatch.setattr(LightTransport, "apply", lambda self, envmap: 3 * apply(self, envmap))
    path = world(
        tmp_path, rng, output={"spp": 1024}, optimizer={"kind": "adam", "iterations": 12, "lr": 0.05}
    )
    assert call(path, "--quiet") == 0
    out = tmp_path / "c_out"
    final = pixels(out / "render_edited.exr")
    own = mi.load_file(str(tmp_path / "scene.xml"), map=str(out / "edited.exr"))
    direct = np.array(mi.render(own, integrator=mi.load_dict({"type": "path"}), spp=4096, seed=1))
    # 16 x 12 pixels in the file, 24 x 18 in the run: both have 8 x 6 blocks.
    a = final.reshape(6, 3, 8, 3, 3).mean((1, 3))
    b = direct.reshape(6, 2, 8, 2, 3).mean((1, 3))
    assert np.sqrt(np.mean((a - b) ** 2)) < 0.03 * b.mean()
    assert final.mean() == pytest.approx(direct.mean(), rel=0.02)
    assert pixels(out / "edited.exr")[:4].mean() < 0.9 * pixels(tmp_path / "map.exr")[:4].mean()


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "value"), [("layers", 0.0), ("siren", 1e-30), ("log-pixels", 0.0)])
def test_a_map_without_light_is_edited_all_the_same(kind, value, tmp_path, rng, capsys):
    path = world(tmp_path, rng, representation={"kind": kind})
    images.write_exr(tmp_path / "map.exr", np.full((8, 16, 3), value, np.float32))
    assert call(path, "--quiet") == 0
    assert ("black" in capsys.readouterr().err) == (value == 0)
    assert np.isfinite(pixels(tmp_path / "c_out" / "edited.exr")).all()


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "spp"), [("pixels", "auto"), ("layers", 16)])
def test_initial_rendering_and_result_are_judged_with_the_same_samples(kind, spp, tmp_path, rng):
    """So that a map in which nothing changes has the same score."""
    target = {"rotate_degrees": 90.0, "spp": 16}
    path = world(tmp_path, rng, optimizer={"iterations": 0}, output={"spp": spp}, target=target)
    out = tmp_path / "out"
    assert call(path, "--quiet", "--out", out, *changed(representation__kind=kind)) == 0
    assert pixels(out / "edited.exr").tobytes() == pixels(tmp_path / "map.exr").tobytes()
    found = measured(out)
    assert found["render"] == found["initial"] and found["worse"] is False
    assert found["envmap"] == found["initial_envmap"] and found["fit"] is None
    assert found["iterations"] == 0 and found["timing"]["per_iteration_ms"] is None and not rows_of(out)
    assert any("100 % of the active texels are unchanged" in line for line in found["choices"]) == (
        kind == "layers"
    )
    assert pixels(out / "render_initial.exr").tobytes() == pixels(out / "render_edited.exr").tobytes()


@pytest.mark.slow
def test_a_result_worse_than_the_input_is_a_warning(tmp_path, rng, monkeypatch, capsys):
    """Also under --quiet."""
    path = world(tmp_path, rng, **PIXELS, optimizer={"iterations": 1})
    compare, scores = pipeline.metrics.compare, iter((20.0, 21.5))

    def worse(edited, wanted, *rest):
        return compare(edited, wanted, *rest) | {"psnr": next(scores, 30.0)}

    monkeypatch.setattr(pipeline.metrics, "compare", worse)
    assert call(path, "--quiet", "--out", tmp_path / "out") == 0
    says = "warning: the result is farther from the target than the input: 20.00 dB now, 21.50 dB before"
    assert says in capsys.readouterr().err
    assert measured(tmp_path / "out")["worse"] is True


@pytest.mark.slow
def test_paint_that_a_result_is_farther_from_is_a_warning(tmp_path, rng, capsys):
    """Brighter is asked for; what is written is darker, by the exposure of the output."""
    stroke = {"type": "light", "ellipse": [0.45, 0.4, 0.06, 0.06], "amount": 2.0}
    tables = {"target": {"kind": "strokes", "strokes": [stroke]}, "output": {"exposure": -3.0}}
    path = world(tmp_path, rng, **PIXELS, **tables)
    assert call(path, "--quiet", "--out", tmp_path / "out") == 0
    said = capsys.readouterr().err
    assert "what was not painted has changed " in said
    assert "the result is farther from the target than the input: -" in said
    assert measured(tmp_path / "out")["worse"] is True


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.05, 1e20])
def test_steps_that_achieve_nothing_are_a_warning(factor, tmp_path, rng, capsys):
    light = (sky(rng) + 0.1) * (1 if factor < 1 else 1e6)
    for name, image in (("map", light), ("other", factor * light)):
        images.write_exr(tmp_path / f"{name}.exr", np.float32(image))
    slow = {"kind": "adam", "iterations": 2, "lr": 1e-6}
    path = world(tmp_path, rng, target={"file": "other.exr"}, optimizer=slow)
    assert call(path, "--quiet", "--out", tmp_path / "out", *changed(representation__kind="pixels")) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "achieved nothing" in line]
    unit = "dB" if factor < 1 else "stops"
    assert re.search(rf"nothing in 2 steps: \S+ {unit} now, \S+ {unit} before", line)


# ---- what is said and set --------------------------------------------------------------------------------


@pytest.mark.slow
def test_quiet_prints_nothing(tmp_path, rng, capsys):
    of_siren = {"representation__hidden": 128, "representation__depth": 3, "fit__epochs": 1200}
    of_siren |= {"optimizer__iterations": 30}
    assert call(world(tmp_path, rng), "--quiet", *changed(**of_siren)) == 0  # the defaults: none is named
    assert capsys.readouterr() == ("", "")


@pytest.mark.slow
def test_preset_overrides_and_an_odd_name_of_the_folder_take_effect(tmp_path, rng):
    path, out = world(tmp_path / "in", rng, **PIXELS), tmp_path / 'é ü 😀 a"b back\\slash'
    assert call(path, "--quiet", "--preset", "draft", "--set", "seed=5", "--out", out) == 0
    assert names(tmp_path) == {"in", out.name} and names(out) >= FILES
    expected = config.load(path, "draft", ["seed=5", f"output.dir={config.quote(str(out))}"])
    assert config.load(out / "config.toml") == expected != config.load(path)


@pytest.mark.slow
def test_the_written_configuration_runs_again_in_its_own_folder(tmp_path, rng, monkeypatch):
    """To the same map; what was there is moved away, but for what is not ours; and where a run has failed."""
    path, out = world(tmp_path, rng, **PIXELS), tmp_path / "c_out"
    assert call(path, "--quiet") == 0
    first = content(out)
    (out / "earlier-note").write_text("mine")
    assert call(out / "config.toml", "--quiet") == 0
    assert pixels(out / "edited.exr").tobytes() == pixels(out / "earlier-1" / "edited.exr").tobytes()
    assert content(out / "earlier-1") == first and (out / "earlier-note").read_text() == "mine"
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "run", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
        assert call(out / "config.toml", "--quiet") == 130
    assert "metrics.json" not in names(out) and call(out / "config.toml", "--quiet") == 0


@pytest.mark.skipif(os.name != "posix", reason="links")
def test_an_input_is_not_moved_away_with_earlier_results_by_any_name(done, tmp_path, capsys):
    path, out, _, _ = done
    before = content(out)
    (tmp_path / "link").symlink_to(out)
    for folder in (out, tmp_path / "link", out.parent / "nowhere" / ".." / out.name):
        capsys.readouterr()
        assert call(path, "--quiet", *changed(input__envmap=str(folder / "edited.exr"))) == 3
        said = capsys.readouterr().err
        assert len(said.splitlines()) == 1 and "edited.exr" in said and "another folder" in said
        assert content(out) == before


# ---- stopping and continuing -----------------------------------------------------------------------------


def test_a_finished_run_has_nothing_to_resume(done, capsys):
    path, folder, _, _ = done
    before = content(folder)
    assert call(path, "--resume") == 0
    assert "complete" in capsys.readouterr().out
    assert call(path, "--resume", *changed(optimizer__iterations=9)) == 3
    assert "another configuration" in capsys.readouterr().err
    assert content(folder) == before


@pytest.mark.slow
def test_a_finished_run_whose_input_has_changed_is_not_complete(tmp_path, rng, capsys):
    """And a run without a report leaves neither page nor preview."""
    optimizer = {"iterations": 1}
    path = world(tmp_path, rng, **PIXELS, output={"report": False}, optimizer=optimizer)
    out = tmp_path / "c_out"
    assert call(path, "--quiet") == 0
    assert names(out) == FILES - {"preview.png", "report.html"} | INFLUENCE
    before = content(out)
    named = Path(config.load(path).input.envmap)
    images.write_exr(named, 2 * images.read(named)[0])
    capsys.readouterr()
    assert call(path, "--resume") == 3
    said = capsys.readouterr().err
    assert said.startswith(f"envedit: {named}: has changed since") and len(said.splitlines()) == 1
    named.unlink()
    assert call(path, "--resume") == 0
    assert content(out) == before


@pytest.mark.slow
def test_a_configuration_in_its_own_folder_is_kept_by_a_first_run_that_resumes(tmp_path, rng):
    path = world(tmp_path, rng, **PIXELS)
    written = path.read_bytes()
    path = path.rename(tmp_path / "config.toml")
    assert call(path, "--resume", "--quiet", "--out", tmp_path, *changed(optimizer__iterations=1)) == 0
    assert path.read_bytes() != written and (tmp_path / "earlier-1" / "config.toml").read_bytes() == written


@pytest.mark.slow
def test_ctrl_c_inside_an_operation_is_ctrl_c(tmp_path, rng, capsys, monkeypatch):
    def press(self, x, slopes):
        raise KeyboardInterrupt

    monkeypatch.setattr(adam_loop._Slope, "eval", press)
    assert call(world(tmp_path, rng, **PIXELS), "--quiet", *changed(optimizer__kind="adam")) == 130
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.slow
def test_a_changed_configuration_is_not_resumed(tmp_path, rng, capsys, monkeypatch):
    path, out = world(tmp_path, rng, **PIXELS), tmp_path / "c_out"

    def interrupting(self, text):
        if text == "writing":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "stage", interrupting)
        assert call(path, "--quiet") == 130
    said = capsys.readouterr().err
    assert "--resume" in said and len(said.splitlines()) == 1
    before = content(out)
    assert call(path, "--quiet", "--resume", *changed(optimizer__iterations=9)) == 3
    said = capsys.readouterr().err
    assert "checkpoint.npz" in said and "another configuration" in said and len(said.splitlines()) <= 2
    assert content(out) == before
    # Without --resume the checkpoint is an earlier run's and is kept like its results.
    assert call(path, "--quiet") == 0
    assert names(out / "earlier-1") == {"checkpoint.npz"} and "checkpoint.npz" not in names(out)


def started(path, cache, *arguments):
    environment = os.environ | {"XDG_CACHE_HOME": str(cache)}
    command = [sys.executable, "-m", "envedit.run", str(path), *arguments]
    return subprocess.Popen(command, cwd=ROOT, env=environment, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE)  # fmt: skip


def stop_at_checkpoint(process, file, number):
    """Send a signal as soon as a new checkpoint is there; return exit code, stdout and stderr."""
    before = file.stat().st_mtime_ns if file.exists() else 0
    try:
        while process.poll() is None and (not file.exists() or file.stat().st_mtime_ns == before):
            time.sleep(0.01)
        process.send_signal(number)
        out, err = process.communicate(timeout=120)
    finally:
        process.kill()
    return process.returncode, out, err


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_interrupted_and_killed_processes_resume_to_the_same_bits(tmp_path, rng):
    """Ctrl-C, then SIGKILL, each in a process of its own; the third process, this one, ends it."""
    optimizer = {"iterations": 150, "checkpoint_s": 0.0}
    path = world(tmp_path, rng, **PIXELS, optimizer=optimizer)
    out = tmp_path / "c_out"
    code, said, errors = stop_at_checkpoint(started(path, tmp_path), out / "checkpoint.npz", signal.SIGINT)
    assert code == 130, errors
    assert "Traceback" not in errors and "--resume" in errors.splitlines()[-1]
    assert names(out) == {"checkpoint.npz", "edited.exr"}
    so_far = pixels(out / "edited.exr")
    assert so_far[4:].tobytes() == pixels(tmp_path / "map.exr")[4:].tobytes()

    process = started(path, tmp_path, "--resume", "--quiet")
    code, _, _ = stop_at_checkpoint(process, out / "checkpoint.npz", signal.SIGKILL)
    assert code == -signal.SIGKILL and "checkpoint.npz" in names(out)
    with np.load(out / "checkpoint.npz") as stored:
        step = json.loads(stored["meta"].tobytes())["state"]["step"]
    assert 0 < step < 150

    assert call(path, "--quiet", "--resume") == 0
    assert call(path, "--quiet", "--out", tmp_path / "whole") == 0
    edited = pixels(out / "edited.exr")
    assert edited.tobytes() == pixels(tmp_path / "whole" / "edited.exr").tobytes() != so_far.tobytes()
    assert names(out) == FILES | INFLUENCE and len(rows_of(out)) == 150


INTERRUPTED_IMPORT = """
import os, signal, sys


class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "mitsuba.python.ad":
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)


sys.meta_path.insert(0, Interrupting())
from envedit.cli.main import main

sys.exit(main())
"""


@pytest.mark.slow
def test_ctrl_c_while_mitsuba_is_imported(tmp_path, rng):
    images.write_exr(tmp_path / "sky.exr", sky(rng))
    for arguments in (["run", str(world(tmp_path, rng))], ["lights", str(tmp_path / "sky.exr")]):
        command = [sys.executable, "-c", INTERRUPTED_IMPORT, *arguments]
        found = subprocess.run(
            command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
        )
        assert found.returncode == 130 and len(found.stderr.splitlines()) == 1, found.stderr


# ---- other commands --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_help_needs_no_renderer(tmp_path):
    """The text comes at once: neither imports nor --help load Mitsuba, Dr.Jit or NumPy."""
    program = (
        "import sys, envedit, envedit.run\n"
        "dir(envedit)\n"
        "try: envedit.run.main(['--help'])\n"
        "except SystemExit as stop: assert stop.code == 0\n"
        "loaded = {'mitsuba', 'drjit', 'numpy', 'OpenEXR'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
        "import envedit.cli.fit\n"
        "assert 'mitsuba' not in sys.modules, 'imported where Ctrl-C does not wait'\n"
        "envedit.Config()"
    )
    found = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    for option in ("CONFIG.toml", "--out", "--preset", "--set", "--resume", "--quiet"):
        assert option in found.stdout


# ---- the picture to paint on -----------------------------------------------------------------------------


def test_the_initial_rendering_is_exported_and_nothing_else(tmp_path, rng, capsys):
    path = world(tmp_path, rng, target={"kind": "image", "file": "later.png"})
    before = content(tmp_path)
    for name in ("a.exr", "c.exr"):
        assert call(path, "--quiet", "--export-initial", tmp_path / name) == 0
    assert capsys.readouterr().out == ""
    assert call(path, "--export-initial", tmp_path / "b.png") == 0
    assert f'file = "{tmp_path / "b.png"}"' in capsys.readouterr().out
    after = content(tmp_path)
    made = {"a.exr", "b.png", "c.exr"}
    assert after.keys() - before.keys() == made | {f"{name}.envedit.json" for name in made}
    assert all(after[key] == before[key] for key in before)
    assert after["a.exr"] == after["c.exr"]  # the same picture again
    assert pixels(tmp_path / "a.exr").shape == (18, 24, 3)
    expected = np.rint(tonemap(pixels(tmp_path / "a.exr").astype(np.float64), "reinhard") * 65535)
    assert expected.max() < 65535 and pixels(tmp_path / "a.exr").max() > 1
    assert np.abs(read_png(tmp_path / "b.png") - expected).max() <= 1


def test_strokes_that_paint_nothing_are_a_mistake_of_the_configuration(tmp_path, rng, capsys):
    strokes = [{"type": "light", "ellipse": [9, 9, 1, 1]}, {"type": "blur", "radius": 0.1, "opacity": 0}]
    assert call(world(tmp_path, rng, target={"kind": "strokes", "strokes": strokes}), "--dry-run") == 2
    says = capsys.readouterr().err.splitlines()[-1]
    assert says.startswith("envedit: target.strokes[0] (light): lies outside the ")
    assert says.endswith("; target.strokes[1] (blur): opacity 0, nothing was painted")


def test_a_map_that_its_turn_leaves_as_it_is_is_not_called_no_target(tmp_path, rng, capsys):
    path = world(tmp_path, rng)
    images.write_exr(tmp_path / "map.exr", np.zeros((8, 16, 3), np.float32))
    assert call(path, *changed(target__file="", target__rotate_degrees=30.0)) == 0
    out = capsys.readouterr().out
    assert "bit for bit: nothing is solved" in out and "no target" not in out


def test_a_dry_run_writes_the_target_and_nothing_else(tmp_path, rng, capsys):
    stroke = {"type": "light", "rectangle": [0, 0, 0.5, 1], "amount": 0.25, "color": "#ffffff"}
    path = world(tmp_path, rng, target={"kind": "strokes", "strokes": [stroke]})
    before = content(tmp_path)
    assert call(path, "--export-initial", tmp_path / "initial.exr", "--quiet") == 0
    assert call(path, "--dry-run") == 0
    out, err = capsys.readouterr()
    assert 'fit.epochs: no effect: needs representation.kind = "siren"' in err
    assert "1 stroke on the initial rendering" in out and "dry_run.png" in out
    after = content(tmp_path)
    made = {"initial.exr", "initial.exr.envedit.json", "c_out/dry_run.png", "c_out/dry_run.exr"}
    assert after.keys() - before.keys() == made
    painted = pixels(tmp_path / "c_out" / "dry_run.exr") - pixels(tmp_path / "initial.exr")
    np.testing.assert_allclose(painted[:, :12], 0.25, rtol=1e-5)
    assert not painted[:, 12:].any()
    bare = ["--dry-run", "--quiet", "--set", "target.strokes=[]"]
    assert call(path, *bare, "--set", "target.kind=envmap") == 0
    capsys.readouterr()
    assert call(path, *bare, "--set", "target.kind=none") == 2
    assert '--dry-run: got target.kind "none"' in capsys.readouterr().err
