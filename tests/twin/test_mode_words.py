"""Modes in words: the sample machine's time constants as its text states them, shapes and shares that add up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data.machine import load_machine
from tests.twin.drives import network
from twin.compile import compile_network
from twin.network import Network
from twin.simulation.start import steady_state
from twin.views.overview import ModeView, machine_modes, mode_views, time_words

SAMPLE = Path(__file__).parents[2] / "machines" / "sample_vmc.yml"


@pytest.fixture(scope="module")
def sample() -> Network:
    return compile_network(load_machine(SAMPLE))


@pytest.fixture(scope="module")
def at_6000(sample: Network) -> list[ModeView]:
    steady = steady_state(sample, {"spindle_rpm": 6000.0}, 20.0)
    return mode_views(sample, machine_modes(sample, steady.factor), steady.degC - 20.0)


def test_the_sample_machine_takes_as_long_as_its_text_says(at_6000: list[ModeView]) -> None:
    """7.7 h, 2.8 h, 1.5 h, 49 min, 20 to 25 min, the rest at most 11 min."""
    said = [time_words(v.time_constant_s) for v in at_6000]
    assert said[:4] == ["7.7 h", "2.8 h", "1.5 h", "49 min"]
    minutes = np.array([v.time_constant_s for v in at_6000]) / 60
    assert len(minutes) == 14 and (np.diff(minutes) < 0).all()
    assert all(19.5 < m < 25.5 for m in minutes[4:7]) and minutes[7] < 11


def test_what_moves_against_what(at_6000: list[ModeView]) -> None:
    words = {time_words(v.time_constant_s): v.label for v in at_6000}
    assert words["7.7 h"] == "bed and table against the room"
    assert words["2.8 h"] == "table against bed"
    assert words["49 min"] == "column_back against head_rear and head_front"
    assert at_6000[6].label == "fixture against table"
    assert [v.label for v in at_6000 if max(v.weight, key=lambda b: v.weight[b]) == "air"] == ["air against the room"]


def test_shapes_are_normed_and_weights_and_shares_add_up(at_6000: list[ModeView]) -> None:
    for v in at_6000:
        assert max(abs(a) for a in v.shape.values()) == pytest.approx(1.0)
        assert sum(v.weight.values()) == pytest.approx(1.0)
    for channel in ("x", "y", "z"):
        assert sum(v.share[channel] for v in at_6000) == pytest.approx(1.0)


def test_the_modes_together_bring_the_displacement_of_the_whole_rise(sample: Network, at_6000: list[ModeView]) -> None:
    steady = steady_state(sample, {"spindle_rpm": 6000.0}, 20.0)
    for row in sample.errors:
        whole = float(row.matrix(sample.values) @ (steady.degC - 20.0))
        assert sum(v.error[row.channel] for v in at_6000) == pytest.approx(whole, abs=1e-9)


def test_one_body_in_a_room() -> None:
    net = network(**{
        "bodies__head": None, "links": {}, "sensors__t_head": None, "exposures": {"shaft-room": "2 W/K"},
        "errors__z__chain": [{"body": "shaft", "gain": "2 um/K"}],
    })  # fmt: skip
    (view,) = mode_views(net, machine_modes(net), np.array([10.0]))
    assert view.time_constant_s == pytest.approx(2500.0) and view.label == "shaft against the room"
    assert view.error == pytest.approx({"z": 20.0}) and view.share == pytest.approx({"z": 1.0})


def test_a_bar_that_bends_its_temperature_moves_within() -> None:
    net = network(**{
        "bodies__head": {
            "capacity": "40 kJ/K", "material": "cast_iron", "shape": "bar", "cells": 6, "conductance": "0.5 W/K",
        },
        "exposures": {"shaft-room": "1 W/K", "head-room": "8 W/K"}, "links": {"shaft-head@0": "1 W/K"},
    })  # fmt: skip
    words = [v.label for v in mode_views(net, machine_modes(net))]
    assert words[0] == "head and shaft against the room" and "head within" in words


@pytest.mark.parametrize(
    ("time_s", "words"),
    [(27864, "7.7 h"), (5400, "1.5 h"), (5399, "1.5 h"), (5390, "90 min"), (2940, "49 min"), (522, "8.7 min"),
     (597.5, "10 min"), (35, "35 s"), (float("inf"), "for ever")],
)  # fmt: skip
def test_times_in_words(time_s: float, words: str) -> None:
    assert time_words(time_s) == words
