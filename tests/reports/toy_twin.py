"""Toy data for figures and reports of a twin."""

from __future__ import annotations

import numpy as np

from twin.views.compared import Compared
from twin.views.heat_flows import HeatFlows
from twin.views.overview import Overview


def batch(name: str = "b$1", offset: float = 0.5, simulated: bool = False) -> Compared:
    time_s = 300.0 * np.arange(25)
    computed = np.stack([20 + time_s / 3600, np.full(25, 20.0), time_s / 1000])
    recorded = computed + np.array([[offset], [-offset], [4 * offset]])
    recorded[1, 5:8] = np.nan
    return Compared(name, simulated, time_s, ("front", "room<1>", "z"), ("K", "K", "um"), recorded, computed)


def flows(view: Overview) -> HeatFlows:
    time_s = np.array([0.0, 1800.0, 3600.0, 7200.0])
    one = np.ones(3)
    return HeatFlows(
        "b1", True, time_s,
        {law: 10.0 * one for law in dict.fromkeys(h.law for h in view.heats)},
        {b.name: (3.0 if b.name == "bed" else 0.4) * one for b in view.bodies},
        {"room": 70.0 * one - 3.2, "floor": -5.0 * one},
        {t.name: (-8.0 if t.name == "bed-table" else 6.0) * one for t in view.ties},
        {b.name: np.array([0.0, 1.0, 2.0, 3.0]) for b in view.bodies},
    )  # fmt: skip
