"""Plain technical English: idioms that only this project would understand are in no text of it.

Text is what a person reads: comments, docstrings and strings of the package, and the pages. Names are not.
"""

import io
import re
import tokenize

import pytest

from tests.oracles import ROOT

pytestmark = pytest.mark.slow

IDIOMS = {
    r"\bcame\b[^.;]*\bwanted\b|: came\b": "got X, expected Y",
    r"\bwanted (?:a|an|one|none|the|text|table|whole)\b": "expected",
    r"(?<!\byou )\bwants?\b": "needs, should be; a picture does not want",
    r"\btells?\b(?! :)|\btold\b": "determines, shows, says, is reported",
    r"\bborn\b|\bbears?\b|\bgives? birth\b": "is added",
    r"\bmanieth\b": "every n-th",
    r"\bnothing special\b": "the noise floor",
    r"\bfor the eye'?s sake\b|\beye's sake\b": "for display",
    r"\bcomes? and goes?\b|\b(?:is|are) (?:not )?chased\b": "transient; is ignored",
    r"\bcounts? (?:for )?less\b(?! than)": "is down-weighted",
    r"\basking what\b": "estimating what",
    r"\b(?:picture|paint|target|rendering|scene|loss)s? (?:does not )?(?:asks?|asked)\b": "requires",
    r"\b(?:picture|pixel|paint|map|sky|loss|network)s? (?:knows?|is content|likes?)\b": "who does what",
}  # fmt: skip
"""Pattern, and what to write instead."""
PACKAGE = sorted(ROOT.glob("envedit/**/*.py"))
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("experiments/*/README.md")]
PAGES += ROOT.glob("envedit/cli/paint/page/*.html")


def texts(file):
    """Yield (line, text) of what a person reads in a file."""
    if file.suffix != ".py":
        yield from enumerate(file.read_text().splitlines(), 1)
        return
    with file.open("rb") as source:
        for token in tokenize.tokenize(io.BytesIO(source.read()).readline):
            kind = tokenize.tok_name[token.type]
            if kind == "COMMENT":
                yield token.start[0], token.string
            elif kind in ("STRING", "FSTRING_MIDDLE"):
                for i, line in enumerate(token.string.splitlines()):
                    if re.match(r"\s+\w+ : \w", line):  # a parameter's name and type
                        continue
                    yield token.start[0] + i, re.sub(r"``[^`]*``|:\w+:`[^`]*`|\{[^{}]*\}", "", line)


def finds(file):
    """List what is to be rewritten in a file."""
    return [
        f"{file.relative_to(ROOT)}:{line}: {found[0]!r} in {text.strip()[:100]!r}; write: {instead}"
        for line, text in texts(file)
        for idiom, instead in IDIOMS.items()
        if (found := re.search(idiom, text, re.I))
    ]


def test_no_idiom_of_our_own_is_in_the_package_or_the_pages():
    assert len(PACKAGE) > 80
    assert not [line for file in PACKAGE for line in finds(file)]
    assert len(PAGES) > 20
    assert not [line for file in PAGES for line in finds(file)]


@pytest.mark.parametrize("line", [
    '"every so-manieth row"', "# a light is born: the picture wants one", "# detail that the picture tells",
    'f"{name}: came {value}, wanted a number"', '"they count less"', '"asking what any light could do"',
    "# speckle comes and goes, and is not chased",
])  # fmt: skip
def test_the_examples_are_found(line, tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    file = tmp_path / "a.py"
    file.write_text(f"x = 0\n{line}\n")
    assert finds(file)
    file.write_text('wanted = told = came = 0  # names are not text\n"""``wanted``: the picture."""\n')
    assert not finds(file)
