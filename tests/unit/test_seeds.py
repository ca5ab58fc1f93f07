"""The table of seeds: no two purposes share one, and no seed is made elsewhere."""

import re

from envedit.core import seeds
from tests.oracles import ROOT


def test_no_two_purposes_share_samples_and_the_largest_seed_stays_one():
    found = vars(seeds.Seeds(0))
    del found["fit"]  # a network's weights are no samples of a rendering
    own = [*found.values(), seeds.pilot(0), seeds.columns(0), *(seeds.recording(0, i) for i in range(1, 10))]
    assert len(set(own)) == len(own)
    most = seeds.Seeds(2**32 - 1)
    checks = most.step_check, most.turn_check, most.solution_check
    assert (most.second_recording, *checks) == (500_008, 700_000, 800_010, 900_000)
    assert most.pass_of_page(3) == 9_000_023


def test_no_other_module_adds_to_a_seed():
    adds = re.compile(r"seed\)? *\+ *[A-Z_\d]|_SEED\b|default_rng\(\d")
    files = [file for file in (ROOT / "envedit").rglob("*.py") if file.name != "seeds.py"]
    assert [f"{file.name}: {line}" for file in files for line in adds.findall(file.read_text())] == []
