"""How well do recordings determine the parameters of a twin?

A machine file gives every free parameter a prior. Four runs of a board whose values differ from the file are
calibrated: the 90 % intervals shrink where the runs are informative, and hold the values that made the recordings.
"""

import tempfile
from pathlib import Path

import numpy as np

import thermodrift as td
from docs.gallery.board import BOARD, board_runs
from docs.gallery.drawing import COLD, GREY, WARM, picture

STAGES = """ [{{minutes: 7, heater1: {0}}}, {{minutes: 6, heater2: {1}}}, {{minutes: 6, heater1: {1}, heater2: 0}}]
"""
POWERS = [(60, 30, 20), (20, 80, 22), (80, 40, 24), (30, 100, 26)]  # %, %, degC
TRUE = {"capacity: {value: 2.5 J/K": "capacity: {value: 3.2 J/K", "value: 12 mW/K": "value: 9 mW/K",
        "value: 3 mW/K": "value: 5 mW/K"}  # fmt: skip

with tempfile.TemporaryDirectory() as folder:
    text = BOARD.read_text()
    for stated, true in TRUE.items():
        text = text.replace(stated, true)
    truth = Path(folder) / "truth.yml"
    truth.write_text(text)
    recorded = board_runs(POWERS, truth, stages=STAGES)
    found = td.calibrate(BOARD, recorded)

SHOWN = {  # prior value, its spread in the logarithm, true value, unit
    "bodies.heater1.capacity": (2.5, 0.4, 3.2, "J/K"),
    "exposures.heater1-room.conductance": (0.012, 0.4, 0.009, "W/K"),
    "links.heater1-heater2.conductance": (0.003, 0.7, 0.005, "W/K"),
}
intervals = {i.name: i for i in found.intervals90}
for name, (_, spread, true, unit) in SHOWN.items():
    i = intervals[name]
    print(f"{name:<36} {i.value:.3g} {unit} (90 %: {i.low:.3g} to {i.high:.3g}), true {true:g}")
    assert i.low * 0.97 < true < i.high * 1.03
    assert np.log(i.high / i.low) < 0.3 * 2 * 1.645 * spread  # the prior is much wider

with picture(
    __file__, "Prior and calibrated 90 % intervals", xlabel="value relative to the true one", xscale="log"
) as ax:
    for row, (name, (prior, spread, true, _)) in enumerate(SHOWN.items()):
        i = intervals[name]
        ax.plot(prior * np.exp([-1.645 * spread, 1.645 * spread]) / true, [row, row], color=GREY, lw=8, alpha=0.6)
        ax.plot([i.low / true, i.high / true], [row, row], color=WARM, lw=4)
    ax.axvline(1.0, color=COLD, lw=1)
    ax.set_yticks(range(len(SHOWN)), [name.replace(".", "\n") for name in SHOWN])
    ax.set_xticks([0.2, 0.5, 1, 2, 4], ["0.2", "0.5", "1", "2", "4"])
    ax.minorticks_off()
