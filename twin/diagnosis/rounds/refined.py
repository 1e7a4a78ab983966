"""Refined twins: the fitted machine as a finer one might be, for what a lumped fit leaves when nothing is missing.

Every body that conducts to others is cut into a bar whose ends differ as its Biot number says; links, sensors and
heat sit at places of their own instead of at its mean (Incropera et al. 2007, ch. 5: lumps hold below Biot 0.1).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from twin.network import Network
from twin.quantity import Value
from twin.schema import Body, ErrorChain, MechanismPart, TwinPart

CELLS = 5
MIDDLE = (0.25, 0.75)  # where a length's mean temperature stands
BIOT = (0.03, 0.5)  # of a body: what leaves it per kelvin over what it conducts from end to end


def refined(part: TwinPart, network: Network, values: np.ndarray, seed: int) -> TwinPart:
    """A random finer twin of a fitted network at parameter values (n,); same parameters by the same names."""
    rng = np.random.default_rng(seed)
    total = network.conductance_W_per_K(values)
    bodies: dict[str, Body] = dict(part.bodies)
    linked = {place.partition("@")[0] for link in part.links.values() for place in link.between}
    for name, body in part.bodies.items():
        if body.shape != "lump" or name not in linked:
            continue
        (cell,) = network.bodies[name]
        biot = float(np.exp(rng.uniform(*np.log(BIOT))))
        through = float(total[cell, cell]) / biot
        bodies[name] = body.model_copy(
            update={"shape": "bar", "cells": CELLS, "conductance": Value(value=f"{through:.6g} W/K")}
        )
    cut = {name for name in bodies if bodies[name].shape == "bar" and part.bodies[name].shape == "lump"}

    def place(at: str) -> str:
        return f"{at}@{rng.uniform(0.0, 1.0):.3f}" if at in cut else at

    links = {
        key: link.model_copy(update={"between": (place(link.between[0]), place(link.between[1]))})
        for key, link in part.links.items()
    }
    sensors = {key: s.model_copy(update={"at": place(s.at)}) for key, s in part.sensors.items()}
    errors = {key: _seen(chain, cut, rng) for key, chain in part.errors.items()}
    mechanisms = {key: _placed(m, cut, rng) for key, m in part.mechanisms.items()}
    return part.model_copy(
        update={"bodies": bodies, "links": links, "sensors": sensors, "mechanisms": mechanisms, "errors": errors}
    )


def _seen(chain: ErrorChain, cut: set[str], rng: np.random.Generator) -> ErrorChain:
    """An error whose lengths and levers end somewhere in a body and not evenly over it."""

    def place(at: str) -> str:
        return f"{at}@{rng.uniform(*MIDDLE):.3f}" if at in cut else at

    links = tuple(c.model_copy(update={"body": place(c.body)}) for c in chain.chain)
    tilts = tuple(t.model_copy(update={"hot": place(t.hot), "cold": place(t.cold)}) for t in chain.tilts)
    return chain.model_copy(update={"chain": links, "tilts": tilts})


def _placed(given: MechanismPart, cut: set[str], rng: np.random.Generator) -> MechanismPart:
    """Heat into a place of its own; shares that are fitted keep the names that they go by."""

    def place(at: str) -> str:
        return f"{at}@{rng.uniform(0.0, 1.0):.3f}" if at in cut else at

    if isinstance(given.into, str):
        return given.model_copy(update={"into": place(given.into)})
    if isinstance(given.into, Mapping):
        into = {place(k) if v == "rest" else k: v for k, v in given.into.items()}
        return given.model_copy(update={"into": into})
    return given
