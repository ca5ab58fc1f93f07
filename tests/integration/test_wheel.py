"""The sdist and the wheel built from it: hold the whole package, which runs where there is no checkout."""

import importlib.metadata
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

import envedit
from tests.oracles import ROOT

pytestmark = pytest.mark.slow
SMALL = ["input.width=16", "scene.width=8", "optimizer.iterations=2"]
SMALL += ["renderer.spp=4", "renderer.max_depth=3", "target.spp=4", "output.spp=4"]


def call(*command, cwd, **environment):
    """Run a program and return what it printed; fails with its output if the program does."""
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=inherited | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def contents(folder):
    """Return relative name -> (size, time of modification) of all files below a folder."""
    found = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(p.relative_to(folder)): (p.stat().st_size, p.stat().st_mtime_ns) for p in found}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Build the sdist from a copy of the sources, and the wheel from the sdist, as for a release."""
    pytest.importorskip("build", reason="the package build, of the extra envedit[dev], is not installed")
    if not (ROOT / "pyproject.toml").is_file():
        pytest.skip("no sources beside these tests")
    folder = tmp_path_factory.mktemp("wheel")
    source, caches = folder / "source", shutil.ignore_patterns("__pycache__")
    for name in ("envedit", "scenes"):
        shutil.copytree(ROOT / name, source / name, ignore=caches)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    try:
        recent = int(importlib.metadata.version("setuptools").split(".")[0]) >= 77
    except importlib.metadata.PackageNotFoundError:
        recent = False
    offline = ["--no-isolation"] if recent else []  # else setuptools is fetched
    call(sys.executable, "-m", "build", *offline, "--outdir", folder, source, cwd=folder)
    (built,), (archive,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    assert built.name.startswith("envedit_hdr-")
    assert built.name.split("-")[:2] == archive.name.removesuffix(".tar.gz").split("-")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Install the wheel alone into a fresh environment that finds the dependencies of this one."""
    root = tmp_path_factory.mktemp("environment")
    call(sys.executable, "-m", "venv", "--without-pip", root, cwd=root)
    python = root / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", python, "-q", "--disable-pip-version-check"]
    call(*pip, "install", "--no-deps", "--no-index", wheel, cwd=root)
    packages = next((root / "lib").glob("python*/site-packages"))
    # Lines of a .pth file are paths; .pth files in those folders, as of an editable envedit, are not read.
    paths = {sysconfig.get_path(name) for name in ("purelib", "platlib")}
    (packages / "dependencies.pth").write_text("\n".join(sorted(paths)) + "\n")
    return root


def test_the_wheel_holds_every_module_and_scene(wheel):
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    modules = {str(p.relative_to(ROOT)) for p in (ROOT / "envedit").rglob("*.py")}
    modules = {name for name in modules if not name.startswith("envedit/integrations/")}  # not installed
    page = {str(p.relative_to(ROOT)) for p in (ROOT / "envedit/cli/paint/page").iterdir()}
    others = {name for name in held if not name.startswith("envedit/scenes/")}
    assert len(modules) > 80 and len(page) > 5 and others == modules | page | {"envedit/py.typed"}
    scenes = {p for p in (ROOT / "scenes").rglob("*") if p.suffix in (".xml", ".ply", ".toml")}
    assert {f"envedit/{p.relative_to(ROOT)}" for p in scenes} <= held


def test_an_installed_envedit_runs_from_an_empty_folder(installed, tmp_path):
    here, cache = tmp_path / "here", tmp_path / "cache"
    here.mkdir()
    environment = {"XDG_CACHE_HOME": str(cache), "PYTHONDONTWRITEBYTECODE": "1"}
    python, command = installed / "bin" / "python", installed / "bin" / "envedit"
    where = call(python, "-c", "import envedit; print(envedit.__file__)", cwd=here, **environment)
    assert Path(where.strip()).is_relative_to(installed)
    assert call(command, "--version", cwd=here, **environment) == f"envedit {envedit.__version__}\n"

    before = contents(installed)
    overrides = [part for one in SMALL for part in ("--set", one)]
    said = call(command, "run", "quickstart", *overrides, cwd=here, **environment)
    results = here / "runs" / "quickstart"
    assert f"results in {results.resolve()}" in said
    assert [str(p.relative_to(here)) for p in here.glob("*/*")] == ["runs/quickstart"]
    left = {p.name for p in results.iterdir()}
    assert {"edited.exr", "render_edited.exr", "metrics.json", "config.toml", "report.html"} <= left
    assert contents(installed) == before

    call(command, "init", "pair", "--out", "edit.toml", cwd=here, **environment)
    assert 'file = "pair"' in (here / "edit.toml").read_text()
    assert ": 0 entries" not in call(command, "cache", cwd=here, **environment).splitlines()[0]
