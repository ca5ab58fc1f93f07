"""The documentation: its site builds, its commands exist, its example runs."""

import argparse
import importlib.util
import itertools
import json
import os
import re
import runpy
import shlex
import subprocess
import sys

import numpy as np
import pytest

import envedit
from envedit.cli.main import COMMANDS
from tests.oracles import ROOT

pytestmark = pytest.mark.slow

DOCS = ROOT / "docs"
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *ROOT.glob("docs/**/*.md"),
    *ROOT.glob("experiments/*/*.md"),
]
ELSEWHERE = ("build", "pytest", "sphinx", "venv", "pip")
"""Programs of others that are run as ``python -m``."""


def test_painting_in_python(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = runpy.run_path(str(DOCS / "paint_in_python.py"))
    result, asked = found["result"], found["asked"]
    assert asked["towards"] > 0.2 and asked["elsewhere"] < 0.03 and 0.5 < asked["reachable"] <= 1
    assert result.envmap.shape == found["sky"].shape and np.isfinite(result.envmap).all()
    assert "is feasible" in capsys.readouterr().out


def test_the_site_builds_offline_without_a_warning(tmp_path):
    for package in ("sphinx", "myst_nb", "furo"):
        pytest.importorskip(package, reason="the extra envedit[docs] is not installed")
    site = [sys.executable, "-m", "sphinx", "-W", "-q", "-c", "docs", ".", str(tmp_path)]
    done = subprocess.run(site, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    built = {str(page.relative_to(tmp_path)) for page in tmp_path.rglob("*.html")}
    assert built >= {"index.html", "docs/index.html", "docs/glossary.html", "experiments/layers/README.html"}
    for page in tmp_path.rglob("*.html"):
        loaded = re.search(r'(?:src|link [^>]*href)="https?:.*', page.read_text())
        assert not loaded, f"{page}: {loaded[0]}"


def test_the_notebook_runs(tmp_path):
    for package in ("jupytext", "ipykernel", "nbconvert"):
        pytest.importorskip(package, reason="the extra envedit[docs] is not installed")
    made = tmp_path / "made.ipynb"
    notebook = [sys.executable, "-m", "jupytext", "--to", "ipynb", "--execute", "--output", str(made)]
    own = {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(
        [*notebook, str(DOCS / "notebooks" / "table_1_in_small.md")],
        env=os.environ | own,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    cells = json.loads(made.read_text())["cells"]
    printed = "".join("".join(o.get("text", [])) for cell in cells for o in cell.get("outputs", []))
    for line in (r"R-SIREN HDR +\d\d\.\d dB", r"Layers \(ours\) .* 3\d\.\d dB"):
        assert re.search(line, printed), printed


def test_the_citation_names_the_version():
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.M)
    assert cited and cited[1] == envedit.__version__


class Parsed(Exception):
    """The options of a command are known."""


def commands():
    """Yield (page, command) of every line of the pages that runs envedit or a module of the repository.

    Assignments of the shell before it, comments, and what follows ``&&`` or ``>`` are left out.
    """
    for page in PAGES:
        text = page.read_text()
        blocks = re.findall(r"^```sh\n(.*?)^```|((?:^(?: {4}|\t).*\n?)+)", text, re.M | re.S)
        lines = [line for block in blocks for line in "".join(block).replace("\\\n", " ").splitlines()]
        for line in [*lines, *re.findall(r"`([^`\n]+)`", text)]:
            for part in re.split(r"&&|;", line.split("  #")[0]):
                part = re.sub(r"^\s*(?:\w+=\S+\s+)*(?:uvx --from \S+ )?(?:\.venv/bin/)?", "", part)
                if re.match(r"(envedit|python) .*\w", part) and "COMMAND" not in part:
                    yield str(page.relative_to(ROOT)), part.split(" > ")[0].strip()


def parse(command, monkeypatch, capsys):
    """Let the program's own parser read a command; it ends there."""
    words = shlex.split(command.replace("$EIGHT", "a"), comments=True)
    if words[0] == "python":
        if len(words) < 3 or words[1] != "-m" or words[2].split(".")[0] in ELSEWHERE:
            return
        module, words = words[2], words[3:]
        assert importlib.util.find_spec(module), f"there is no module {module}"
    else:
        module, words = "envedit", words[1:]
    if module.startswith("tests.") or (module == "envedit" and not words):
        return
    # Of a synopsis, or a command that is only named, the options are looked for in the help.
    synopsis = "[" in command or (module == "envedit" and len(words) == 1)
    options = set(re.findall(r"--[a-z][a-z-]+", command))
    words = [*itertools.takewhile(lambda word: word[:1].islower(), words), "--help"] if synopsis else words
    monkeypatch.setattr(sys, "argv", [module, *words])
    capsys.readouterr()
    with pytest.raises((Parsed, SystemExit)) as ended:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    said = capsys.readouterr()
    assert ended.type is Parsed or ended.value.code in (0, None), f"{command}: not understood\n{said.err}"
    if synopsis:
        assert not {option for option in options if option not in said.out}, command


@pytest.mark.filterwarnings("ignore:.* found in sys.modules after import:RuntimeWarning")
@pytest.mark.parametrize("page", sorted({page for page, _ in commands()}))
def test_every_command_in_the_pages_is_understood(page, monkeypatch, capsys):
    read = argparse.ArgumentParser.parse_args

    def parse_args(parser, *given, **named):
        found = read(parser, *given, **named)
        if parser.prog == "envedit":
            return found  # goes on to the parser of the command
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_args)
    for command in sorted({command for where, command in commands() if where == page}):
        parse(command, monkeypatch, capsys)


def test_commands_are_found_and_a_wrong_one_is_noticed(monkeypatch, capsys):
    found = [command for _, command in commands()]
    assert len(set(found)) > 40 and {c.split()[1] for c in found if c.startswith("envedit ")} >= set(COMMANDS)
    with pytest.raises(AssertionError, match="not understood"):
        parse("envedit run quickstart --no-such-option", monkeypatch, capsys)
