"""A network with every candidate disabled: it is the baseline, and its derivatives are what each candidate would do."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from data.arrays import Array
from data.machine import Machine
from diagnosis.candidates.library import candidates
from diagnosis.contracts import Candidate, Where
from diagnosis.fitting.signatures import with_disabled
from tests.diagnosis.small_cases import driven, equipped, four_bodies, two_bodies
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.network import Network
from twin.quantity import Value
from twin.schema import MechanismPart, TwinPart, twin_part
from twin.simulation import simulate
from twin.simulation.inputs import Inputs, inputs_of
from twin.simulation.sensitivity import Selected, sensitivities

SUBSTEPS = 2
TOLERANCE = 3e-3  # of a derivative's largest value
SWITCHING = 8  # substeps for a thermostat: within the interval in which it switches a derivative is of first order
ALONG = ("time_skew", "joint_slip")  # they have a derivative to the right only


@dataclass(frozen=True)
class Small:
    """A machine, two driven runs, and every body at a temperature of its own."""

    machine: Machine

    @property
    def part(self) -> TwinPart:
        return twin_part(self.machine)

    @property
    def candidates(self) -> list[Candidate]:
        return candidates(self.machine, self.part)

    def network(self, c: Candidate | None = None, values: dict[str, float] | None = None) -> Network:
        part = self.part if c is None else c.applied(self.part, {k: Value(value=v) for k, v in (values or {}).items()})
        return compile_network(self.machine, part=part)

    def run(self, network: Network, substeps: int = SUBSTEPS) -> tuple[Inputs, Array]:
        start = np.full((1, 2, network.n_cells), 22.0)
        for k, body in enumerate(self.part.bodies):
            start[..., network.bodies[body]] = 23.0 + 2.0 * k
        return inputs_of(network, driven(self.machine, 2), substeps), start

    def shown(self, network: Network, substeps: int = SUBSTEPS) -> Array:
        """All channels (B, K, C)."""
        out = simulate(network, network.values, *self.run(network, substeps), tolerance_K=1e-9)
        return np.concatenate([out.readings[0], out.errors[0]], axis=-1)

    def slopes(self, network: Network, numbers: list[int], substeps: int = SUBSTEPS) -> Array:
        """Of all channels by the parameters, (Q, B, K, C)."""
        _, *slopes = sensitivities(
            network, network.values, *self.run(network, substeps), Selected(numbers), tolerance_K=1e-8
        )
        return np.concatenate(slopes, axis=-1)

    def difference(self, c: Candidate, amplitude: str, substeps: int = SUBSTEPS) -> Array:
        """The same by simulations with this candidate alone, enabled at a thousandth of its usual size."""
        mechanism, off = MECHANISMS[c.mechanism], c.amplitudes[amplitude]
        spec = mechanism.spec(amplitude)
        step = 1e-3 * float(spec.value or spec.spread)

        def at(value: float) -> Array:
            values = {**mechanism.null_values, **c.amplitudes, amplitude: value}
            least = {a: max(v, 1e-12) if mechanism.spec(a).scale == "logit" else v for a, v in values.items()}
            return self.shown(self.network(c, least), substeps)

        if c.mechanism in ("jacket_chiller", "joint_slip"):
            step /= 100
        if spec.low < off < spec.high and c.mechanism not in ALONG:
            return (at(off + step) - at(off - step)) / (2 * step)
        step = step if off < spec.high else -step
        if c.mechanism in ALONG:
            return (at(off + step) - at(off)) / step
        return (4 * at(off + step) - at(off + 2 * step) - 3 * at(off)) / (2 * step)


SMALL = {"two bodies": Small(two_bodies()), "four bodies": Small(equipped())}
machines = pytest.mark.parametrize("small", SMALL.values(), ids=SMALL)


def smooth(small: Small) -> list[Candidate]:
    return [c for c in small.candidates if c.amplitudes and not c.variant_of]


def one_of_each(every: list[Candidate]) -> list[Candidate]:
    """The last place of every mechanism."""
    return list({c.mechanism: c for c in every}.values())


def compared(small: Small, chosen: list[Candidate], substeps: int) -> list[tuple[float, str]]:
    """The largest error of every derivative, of its own size."""
    found = with_disabled(small.machine, small.part, small.candidates)
    numbers = sorted({j for js in found.amplitudes.values() for j in js})
    slopes = dict(zip(numbers, small.slopes(found.network, numbers, substeps), strict=True))
    out = []
    for c in chosen:
        assert len(found.amplitudes[c.name]) == len(c.amplitudes), c.name
        moved = 0.0
        for amplitude, j in zip(c.amplitudes, found.amplitudes[c.name], strict=True):
            expected = small.difference(c, amplitude, substeps)
            if c.mechanism == "time_skew":  # the last row is held beyond the end
                expected[:, -1] = slopes[j][:, -1]
            size = float(np.abs(expected).max())
            gap = float(np.abs(slopes[j] - expected).max())
            assert size > 1e-9 or gap < 1e-9, (c.name, amplitude)
            out.append((gap / max(size, 1e-9), f"{c.name}.{amplitude}"))
            moved = max(moved, size)
        assert moved > 1e-7, f"{c.name} does nothing"
    return out


@pytest.mark.parametrize(
    "small", [SMALL["two bodies"], pytest.param(SMALL["four bodies"], marks=pytest.mark.slow)], ids=SMALL
)
def test_its_derivatives_are_those_of_the_enabled_candidates(small: Small) -> None:
    chosen = [c for c in one_of_each(smooth(small)) if c.mechanism != "jacket_chiller"]
    assert len(chosen) > 20
    gaps = compared(small, chosen, SUBSTEPS)
    assert max(gaps)[0] < TOLERANCE, sorted(gaps)[-3:]


def test_a_thermostats_derivative_is_right_in_fine_steps() -> None:
    small = SMALL["two bodies"]
    chosen = [c for c in smooth(small) if c.mechanism == "jacket_chiller"]
    gaps = compared(small, chosen, SWITCHING)
    assert len(gaps) == 4 and max(gaps)[0] < 1e-3


@machines
def test_with_everything_disabled_it_is_the_baseline(small: Small) -> None:
    every = [c for c in smooth(small) if not MECHANISMS[c.mechanism].null_values]
    network = with_disabled(small.machine, small.part, every).network
    np.testing.assert_allclose(small.shown(network), small.shown(small.network()), rtol=0, atol=1e-12)


@machines
def test_structures_at_null_values_hardly_load_it(small: Small) -> None:
    structures = [c for c in smooth(small) if MECHANISMS[c.mechanism].null_values]
    network = with_disabled(small.machine, small.part, structures).network
    gap = np.abs(small.shown(network) - small.shown(small.network()))
    assert structures and 0 < gap.max() < 2e-3


def test_heat_that_a_disabled_factor_multiplies_stays_enabled() -> None:
    small = SMALL["four bodies"]
    feedback = next(c for c in smooth(small) if c.mechanism == "viscosity_feedback")
    base, network = small.network(), with_disabled(small.machine, small.part, [feedback]).network
    own = [h for h in network.heats if h.law.name == "friction"]
    assert [h.disabled for h in own] == [False, True]
    assert [len(h.factors) for h in own] == [0, 1]
    name = "mechanisms.friction.lubrication"
    slopes = small.slopes(network, [network.index(name)])
    np.testing.assert_allclose(slopes, small.slopes(base, [base.index(name)]), atol=1e-12)
    assert np.abs(slopes).max() > 0.1


def test_every_error_of_a_shared_instance_has_its_own_amplitude() -> None:
    channels = four_bodies().model_dump()["channels"]
    chain = {"chain": [{"body": "bed", "length": "0.2 m"}], "uniform_length": "0.2 m"}
    machine = four_bodies(errors__y=chain)
    machine = machine.model_copy(update={"channels": {**machine.channels, "y": machine.channels["z"]}})
    assert "y" not in channels
    small = Small(machine)
    bars = [c for c in smooth(small) if c.name in ("mandrel_fixture_z_head", "mandrel_fixture_y_head")]
    found = with_disabled(machine, small.part, bars)
    (y,), (z,) = (found.amplitudes[c.name] for c in sorted(bars, key=lambda c: c.name))
    of_y, of_z = small.slopes(found.network, [y, z])
    order = [e.channel for e in found.network.errors]
    n = len(found.network.readings)
    for slope, error in ((of_y, "y"), (of_z, "z")):
        moved = np.abs(slope[..., n:]).max(axis=(0, 1)) > 1e-6
        assert [name for name, m in zip(order, moved, strict=True) if m] == [error]


def test_what_does_not_compile_is_told_and_the_rest_stays() -> None:
    small = SMALL["two bodies"]
    good = next(c for c in smooth(small) if c.mechanism == "cabinet_heat")
    assert good.part is not None
    bad = replace(good, name="cabinet_heat_hood", part=good.part.model_copy(update={"into": "hood"}))
    found = with_disabled(small.machine, small.part, [good, bad])
    assert set(found.amplitudes) == {good.name}
    assert list(found.left_out) == [bad.name]
    assert "mechanisms.cabinet_heat_hood.into" in found.left_out[bad.name] and "'hood'" in found.left_out[bad.name]


def test_a_candidate_without_an_amplitude_is_absent_from_the_network() -> None:
    small = SMALL["two bodies"]
    part = MechanismPart(law="sensor_swap", acts_on=("t_shaft", "t_head"))
    swap = Candidate("sensor_swap", Where("sensor", "t_shaft"), "swap", "two labels exchanged", part, fault=True)
    found = with_disabled(small.machine, small.part, [swap])
    assert not found.amplitudes and not found.left_out
    assert found.network.parameters == small.network().parameters
