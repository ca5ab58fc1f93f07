"""What several tests share: statistics, plain references, scenes, small runs, the extremes as data."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
"""The repository."""
