"""What every random choice of a run is seeded with: one table, all from the run's ``seed``.

What is judged shares no samples with what was optimised through, and one rendering none with another. Random
signs (:data:`SIGNS`) and the calibration of a budget are the same in every run.
"""

from __future__ import annotations

SIGNS = 0
"""Seed of random signs, by which sums over many texels are estimated."""
_WORDS = 2**32  # where a seed is a setting of its own, or goes to Mitsuba as it is


class Seeds:
    """The seeds of a run, derived from that of its configuration."""

    def __init__(self, seed: int):
        # Of a network and its fit
        self.fit = seed
        # T's recording, and the light of other lamps; further ones by :func:`recording`, :func:`pilot` and
        # :func:`columns`. Of a path tracer, ``sample_tea_32(2 step, transport)``: rendering and gradient.
        self.transport = seed
        # T once more, to see what in it is noise
        self.second_recording = (seed + 500_009) % _WORDS
        # Renderings that decide about the solver's steps, and about the turn of the sky, and that show what T
        # misses of the solution
        self.step_check = (seed + 700_001) % _WORDS
        self.turn_check = (seed + 800_011) % _WORDS
        self.solution_check = (seed + 900_001) % _WORDS
        # The target, rendered under another map; and renderings that show how noisy it is
        self.target = seed + 7_000_003
        self.target_again = seed + 7_500_013
        # The rendering that is painted on
        self.exported = seed + 8_000_009
        # The initial rendering where a map is only adjusted, without a target
        self.painted_initial = seed + 9_000_011
        # The rendering of the result, and the initial one that it is compared with: the same samples
        self.judged = seed + 9_000_012
        # The rendering that the painting page shows; further passes count on from it
        self.page = seed + 9_000_021

    def pass_of_page(self, i: int) -> int:
        """Return the seed of pass ``i`` of :attr:`page`."""
        return (self.page + i) % _WORDS


def recording(transport: int, epoch: int) -> int:
    """Return the seed of T's recording after so many refreshes."""
    return transport + 1_000_003 * epoch


def pilot(transport: int) -> int:
    """Return the seed of the few samples by which T's path depth and rows are chosen."""
    return transport + 104_729


def columns(transport: int) -> int:
    """Return the seed of the paths of T's exact columns."""
    return transport + 7_919
