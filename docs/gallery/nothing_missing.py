"""Simulation and recordings agree: how large an effect may still hide?

The machine file is right, and the diagnosis says so: the error of left-out runs is the noise. For every effect of the
library it states how large it would have had to be to be seen; here constant heats, next to 1 W of a heater.
"""

import thermodrift as td
from docs.gallery.board import BOARD, board_runs
from docs.gallery.drawing import COLD, picture

POWERS = [(60, 30, 20), (20, 80, 22), (80, 40, 24), (30, 100, 26)]  # %, %, degC

findings = td.diagnose(BOARD, board_runs(POWERS)).findings

assert findings.verdict == "consistent" and not findings.findings
rms = findings.fit.left_out_rms
for channel, noise in rms.noise_floor.items():
    assert 0.8 * noise < rms.before[channel] < 1.4 * noise
heats = [d for d in findings.detection_limits if d.unit == "W" and d.limit and "(" not in d.words]
heats = sorted(heats, key=lambda d: d.limit)
assert len(heats) >= 4 and heats[-1].limit < 0.05  # W; a twentieth of a heater at full power is seen
print(findings.statement.split(". An effect")[0])

labels = [f"{d.mechanism.replace('_', ' ')}: {d.words.split(': ')[1]}" for d in heats]
title = "The least heat that these runs would have shown"
with picture(__file__, title, xlabel="limit, mW (a heater at full power: 1000 mW)") as ax:
    ax.barh(labels, [1000 * d.limit for d in heats], color=COLD)
    ax.set_xlim(0, 50)
    ax.invert_yaxis()
