"""Refined twins: machines that a lumped network may represent, and how their recordings would differ.

A body of a lumped network has one temperature; a casting has gradients, a sensor sits somewhere in them, heat enters
somewhere else. What that makes of recordings is no noise: it has a shape, given by this machine, its inputs and its
sensors. The shape is drawn by simulation and taken as the covariance of the misfit (Bayesian approximation error,
Kaipio and Somersalo 2007, J. Comput. Appl. Math. 198, 493; model discrepancy, Kennedy and O'Hagan 2001).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from diagnosis.candidates.library import ends_of
from diagnosis.fitting.carried import on_network
from diagnosis.policy import POLICY
from twin.calibration.fit_problem import x_of
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.network import Network
from twin.quantity import Value
from twin.schema import Body, ErrorChain, Link, MechanismPart, TwinPart
from twin.simulation import simulate
from twin.simulation.coupling import Trajectory
from twin.simulation.inputs import Inputs


@dataclass(frozen=True)
class Dice:
    """Random numbers of one refined twin, of each by the name of what it is drawn for.

    Machines that differ by an effect have the same refinement in all else, so that evidence under the one's twins and
    the other's differs by the effect and not by chance (common random numbers, Kahn and Marshall 1953, J. Oper. Res.
    Soc. Am. 1, 263).
    """

    seed: int
    twin: int

    def of(self, *name: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, self.twin, crc32(".".join(name).encode())])


def drawn_misfits(
    machine: Machine,
    part: TwinPart,
    batches: Sequence[Batch],
    problem: CalibrationProblem,
    centre: Array,
    spread: Array,
    draws: int,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[list[Array], list[Array]]:
    """What `draws` refined twins show beyond the lumped one of the same values, and what it does to each that drivers
    change at other times within their rows; (n_b, draws) of every batch in units of the given noise.

    Args:
        centre, spread: mean and sd (p,) of the z that they have.

    Raises:
        WorkError: no more than one draw in four can be simulated.
    """  # fmt: skip
    out: list[list[Array]] = []
    usual_W, most = _usual_W(problem, problem.values_at(x_of(problem.unknowns, centre))), runaway(problem)
    for k in range(4 * draws):
        dice = Dice(seed, k)
        z = centre + spread * [dice.of("value", u.name).normal() for u in problem.unknowns]
        try:
            drawn = _misfit(machine, part, batches, problem, z, usual_W, dice)
        except (InputError, WorkError):
            continue  # a draw that no machine has
        if not all(np.abs(own).max() <= most for own in drawn):
            continue
        out.append(drawn)
        if progress:
            progress(len(out), draws)
        if len(out) == draws:
            both = [np.stack(own, axis=1) for own in zip(*out, strict=True)]
            return [d[..., 0] for d in both], [d[..., 1] for d in both]
    raise WorkError(
        f"machine {machine.machine}: {len(out)} of {4 * draws} refined twins could be simulated, expected {draws}; "
        "check the values of the machine file"
    )


def runaway(problem: CalibrationProblem) -> float:
    """What no machine differs from the recordings by, in units of the given noise: a multiple of the largest range of a
    channel within a batch."""
    ranges = [np.ptp(m.value[m.channel == c]) / problem.noise[c] for m in problem.measured for c in m.usable.tolist()]
    return POLICY.drawn_max_misfit * float(max(ranges))


def _misfit(
    machine: Machine,
    part: TwinPart,
    batches: Sequence[Batch],
    problem: CalibrationProblem,
    z: Array,
    usual_W: Mapping[str, float],
    dice: Dice,
) -> list[Array]:
    """One refined twin less the lumped one with the same totals, and with other times of changes less itself, (n_b, 2)
    of every batch."""
    network, values = problem.network, problem.values_at(x_of(problem.unknowns, z))
    finer, cut = refined(part, network, values, dice)
    fine = on_network(problem, batches, _bent(compile_network(machine, part=finer), usual_W, dice))
    known = {p.name: v for p, v in zip(network.parameters, values, strict=True)}
    own_values = np.array(
        [known.get(p.name, v) for p, v in zip(fine.network.parameters, fine.network.values, strict=True)]
    )
    n = len(batches)
    for body in cut:  # the history of a machine causes gradients
        cells = fine.network.bodies[body]
        sd_K = max(POLICY.start_gradient_min_sd_K, POLICY.start_gradient_share * network.start_spread_K)
        across_K = dice.of("start", body).normal(0.0, sd_K, (n, 1))
        fine.start_degC[:, cells] += across_K * np.linspace(-1.0, 1.0, len(cells))
    laws = [h.law.name for h in network.heats if not h.disabled]
    scatter = {name: np.exp(dice.of("run", name).normal(0.0, POLICY.run_to_run_log_sd, n)) for name in laws}
    last = Trajectory()  # the refined twin's begins at the lumped one's, where its laws act at as many places
    lump = _shown(problem, values, lambda inputs: inputs, last)
    own = _shown(fine, own_values, lambda inputs: inputs.with_own({**inputs.times, **scatter}), last)
    late = _shown(fine, own_values, lambda inputs: _timed(inputs.with_own({**inputs.times, **scatter}), dice), last)
    return [np.column_stack([f - g, t - f]) for f, g, t in zip(own, lump, late, strict=True)]


def _usual_W(problem: CalibrationProblem, values: Array) -> dict[str, float]:
    """The root mean square of every heat while it flows, by its law's name."""
    inputs, start = problem.inputs_at([np.zeros(q) for q in problem.nuisance_sizes])
    run = simulate(problem.network, values, inputs, start, keep_cells=True)
    flowing = {name: w[0][run.valid & (np.abs(w[0]) > 0)] for name, w in run.heat_W.items()}
    return {name: float(np.sqrt(np.mean(w**2))) for name, w in flowing.items() if len(w)}


def _bent(network: Network, usual_W: Mapping[str, float], dice: Dice) -> Network:
    """The network whose heats grow with their drivers by other powers than their laws state."""

    def exponent(name: str) -> float:
        return float(np.exp(dice.of("exponent", name).normal(0.0, POLICY.drawn_exponent_log_sd)))

    heats = tuple(
        replace(h, bent=(usual_W[h.law.name], exponent(h.law.name))) if h.law.name in usual_W else h
        for h in network.heats
    )
    return replace(network, heats=heats)


def _timed(inputs: Inputs, dice: Dice) -> Inputs:
    """Inputs whose drivers change a little sooner or later: no row says when within it a driver changed."""
    drivers = {}
    for name, held in inputs.drivers.items():
        step, most = np.nan_to_num(np.diff(held, axis=1)), POLICY.drawn_timing_rows
        sooner = dice.of("time", name).uniform(-most, most, step.shape)
        drivers[name] = moved = held.copy()
        moved[:, :-1] += np.maximum(sooner, 0.0) * step
        moved[:, 1:] += np.minimum(sooner, 0.0) * step
    return replace(inputs, drivers=drivers)


def _shown(
    problem: CalibrationProblem, values: Array, acted: Callable[[Inputs], Inputs], last: Trajectory
) -> list[Array]:
    """What every batch shows, (n_b,) in units of the given noise, of what has `acted` on it."""
    inputs, start = problem.inputs_at([np.zeros(q) for q in problem.nuisance_sizes])
    run = simulate(problem.network, values, acted(inputs), start, last=last)
    series = np.concatenate([run.readings[0], run.errors[0]], axis=-1)
    return [m.of(s) / problem.noise[m.channel] for m, s in zip(problem.measured, series, strict=True)]


def refined(part: TwinPart, network: Network, values: Array, dice: Dice) -> tuple[TwinPart, list[str]]:
    """A twin part whose lumps are chains of cells with inner resistance, and the bodies that were cut; links, heats and
    sensors are anywhere in them. Its parameters keep their names."""
    total = network.conductance_W_per_K(values)
    joined = {place.partition("@")[0] for link in part.links.values() for place in link.between}
    joined |= {e.of.partition("@")[0] for e in part.exposures.values()}
    bodies: dict[str, Body] = dict(part.bodies)
    through: dict[str, float] = {}
    cut = [name for name, body in part.bodies.items() if body.shape == "lump" and name in joined]
    for name in cut:
        (cell,) = network.bodies[name]
        rng = dice.of("body", name)
        thin = rng.random() < POLICY.thin_body_share
        median, log_sd = POLICY.thin_body_conductance if thin else POLICY.inner_conductance
        through[name] = float(total[cell, cell]) * float(np.exp(rng.normal(np.log(median), log_sd)))
        cells = int(rng.integers(POLICY.drawn_cells[0], POLICY.drawn_cells[1] + 1))
        bodies[name] = part.bodies[name].model_copy(
            update={"shape": "bar", "cells": cells, "conductance": Value(value=f"{through[name]:.6g} W/K")}
        )

    def place(of: str, at: str, low: float = 0.0, high: float = 1.0) -> str:
        return f"{at}@{dice.of('place', of, at).uniform(low, high):.3f}" if at in cut else at

    near: dict[str, list[str]] = {}
    for link in part.links.values():
        one, other = ends_of(link)
        near.setdefault(one, []).append(other)
        near.setdefault(other, []).append(one)
    links = {
        key: link.model_copy(update={"between": (place(key, link.between[0]), place(key, link.between[1]))})
        for key, link in part.links.items()
    }
    update = {
        "bodies": bodies,
        "links": links | _webs(bodies, cut, through, dice) | _stray(near, network, total, place, dice),
        "sensors": {key: s.model_copy(update={"at": place(key, s.at)}) for key, s in part.sensors.items()},
        "mechanisms": {key: _placed(key, m, place, near, dice) for key, m in part.mechanisms.items()},
        "errors": {key: _seen(key, chain, place) for key, chain in part.errors.items()},
    }
    return part.model_copy(update=update), cut


def _webs(bodies: Mapping[str, Body], cut: Sequence[str], through: Mapping[str, float], dice: Dice) -> dict[str, Link]:
    """Paths within the castings in addition to the chain, in one draw of two."""
    out = {}
    if dice.of("webs").random() < POLICY.webbed_share:
        for name in cut:
            rng = dice.of("web", name)
            cells = int(bodies[name].cells)  # type: ignore[arg-type]
            for k in range(cells):
                one, other = (rng.permutation(cells)[:2] + 0.5) / cells  # of two cells: a link needs two ends
                share = through[name] * rng.uniform(*POLICY.web_conductance)
                out[f"web_{name}_{k}"] = _link(f"{name}@{one:.6f}", f"{name}@{other:.6f}", share)
    return out


def _stray(
    near: Mapping[str, Sequence[str]], network: Network, total: Array, place: Callable[..., str], dice: Dice
) -> dict[str, Link]:
    """Weak paths between bodies that have a neighbour in common."""
    out = {}
    second = {tuple(sorted((a, b))) for own in near.values() for a in own for b in own if a != b}
    for a, b in sorted(second):
        if b not in near[a]:
            least = min(float(sum(total[c, c] for c in network.bodies[n])) for n in (a, b))
            key = f"stray_{a}_{b}"
            share = dice.of(key).uniform(0.0, POLICY.stray_conductance)
            out[key] = _link(place(key, a), place(key, b), least * share)
    return out


def _link(one: str, other: str, conductance_W_per_K: float) -> Link:
    return Link(between=(one, other), conductance=Value(value=f"{conductance_W_per_K:.6g} W/K"))


def _seen(key: str, chain: ErrorChain, place: Callable[..., str]) -> ErrorChain:
    """The error chain with its lengths and levers attached about the middle of the bodies."""
    span = POLICY.drawn_length_centre
    links = tuple(c.model_copy(update={"body": place(key, c.body, *span)}) for c in chain.chain)
    tilts = tuple(
        t.model_copy(update={"hot": place(key, t.hot, *span), "cold": place(key, t.cold, *span)}) for t in chain.tilts
    )
    return chain.model_copy(update={"chain": links, "tilts": tilts})


def _placed(
    key: str, given: MechanismPart, place: Callable[..., str], near: Mapping[str, Sequence[str]], dice: Dice
) -> MechanismPart:
    """The mechanism with its heat into a place of the body, a little of it into a neighbour; fitted shares keep their
    names."""
    into = {given.into: "rest"} if isinstance(given.into, str) else given.into
    if not isinstance(into, Mapping):
        return given
    rest = next(k for k, v in into.items() if v == "rest")
    neighbours = near.get(rest.partition("@")[0], ())
    out: dict[str, Value | str] = {place(key, k) if v == "rest" else k: v for k, v in into.items()}
    if neighbours and isinstance(given.into, str) and MECHANISMS[given.law].takes_from is None:
        rng = dice.of("leak", key)
        neighbour, share = neighbours[int(rng.integers(len(neighbours)))], rng.uniform(0.0, POLICY.leak_share)
        out[place(key, neighbour)] = Value(value=float(f"{share:.4g}"))
    return given.model_copy(update={"into": out})
