"""Weights that runs find by themselves, and what is chosen where they are."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from envedit import config
from envedit.config import presets
from envedit.core.array_cache import cache_folder

if TYPE_CHECKING:
    from envedit.losses.perceptual.distances import Dists, Lpips

VGG, DISTS = "vgg16_features.npz", "dists_alpha_beta.npz"
BACKBONES = {"alex": "alexnet_features.npz", "vgg": VGG}
HEADS = "lpips_v0.1_{}.npz"
"""Names of the files in a folder of weights."""

DISTS_WEIGHT = 0.1
"""``loss.dists`` of a SIREN at "auto", where weights are; 0 elsewhere. Measured, with the steps:
docs/decisions/edit_of_the_network.md."""
STEPS_WITH_DISTS = 300
"""``optimizer.iterations`` at "auto" with DISTS; without it, as for other maps of many parameters."""


def files(settings: config.Config) -> dict[str, str]:
    """Return the weight files that a configuration uses: backbone and heads, vgg and dists.

    Files that it names come first, then those of the folder that it names, whether they are there or not,
    then those in the folder of caches, where both of a pair are. What is missing is not in the table.
    """
    named = settings.perceptual
    chosen = named.weights or cache_folder("weights")
    pairs = {("backbone", "heads"): (BACKBONES[named.network], HEADS.format(named.network))}
    if settings.loss.dists:
        pairs["vgg", "dists"] = VGG, DISTS
    chosen_files: dict[str, str] = {}
    for keys, names in pairs.items():
        paths = [getattr(named, key) for key in keys]
        if not paths[0] and chosen:
            paths = [os.path.join(chosen, name) for name in names]
            if not named.weights and not all(map(os.path.isfile, paths)):
                continue
        if paths[0]:
            chosen_files |= zip(keys, paths, strict=True)
    return chosen_files


def settled(settings: config.Config) -> config.Config:
    """Put numbers in the place of "auto" for ``loss.dists`` and ``optimizer.iterations``, by the weights."""
    loss, optimizer = settings.loss, settings.optimizer
    able = "vgg" in files(settings)
    if loss.dists == "auto":
        chosen = able and settings.representation.kind == "siren"
        loss = replace(loss, dists=DISTS_WEIGHT if chosen else 0.0)
    if optimizer.iterations == "auto":
        plain = presets.MANY_PARAMETERS["standard"]["optimizer"]["iterations"]
        optimizer = replace(optimizer, iterations=STEPS_WITH_DISTS if able and loss.dists else plain)
    return replace(settings, loss=loss, optimizer=optimizer)


class Networks(NamedTuple):
    """What the perceptual terms of a run are computed with."""

    settings: config.Config  # with numbers in the place of "auto"
    dists: Dists | None  # where the loss has it, and there are weights
    lpips: Lpips | None  # where there are weights
    note: str  # that DISTS is off, as there are no weights; "" where it is on, or not asked for


def load(settings: config.Config) -> Networks:
    """Settle a configuration by the weights that there are, and load the networks.

    InputError if a file cannot be read, or lacks a tensor.
    """
    from envedit.losses.perceptual import backbones, distances

    chosen = settled(settings)
    paths = files(chosen)
    dists = None
    lpips = None
    if "vgg" in paths:
        dists = distances.Dists(backbones.Backbone.load("vgg", paths["vgg"]), paths["dists"])
    if "backbone" in paths:
        kind = chosen.perceptual.network
        lpips = distances.Lpips(kind, backbones.Backbone.load(kind, paths["backbone"]), paths["heads"])
    return Networks(chosen, dists, lpips, missing(settings))


def missing(settings: config.Config) -> str:
    """Say that DISTS is off without weights, and how to get them; "" where it is on, or not asked for."""
    dists = settings.loss.dists
    if dists == "auto":
        dists = settings.representation.kind == "siren"
    if settings.target.kind == "none" or not dists or "vgg" in files(settings):
        return ""
    return "DISTS is off: no trained weights; to fetch them once, 64 MB: `envedit weights`"
