"""What every unknown does to the heat balance: the right-hand sides of the forward sensitivities."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from twin.network import Edge, Heat, Network
from twin.simulation.air import effect_K, follows
from twin.simulation.balance import Balance, Borders, HeatSource
from twin.simulation.coupling import outlets
from twin.simulation.inputs import STEP, stepped
from twin.simulation.modes import first_order_hold
from twin.simulation.run import Solved, bulge_K
from twin.simulation.schedule import factor_series
from twin.simulation.start import excess_K


@dataclass
class Unknown:
    """One right-hand side: heat as pairs of a direction (R, N) and a series (B, M, 2), and what stands beside it.

    A capacity's derivative is the sum of what the heat makes and of ``-ratio (T - T(0))``: so the heat follows the
    temperatures, which are smooth, and not their rates, which jump. `start_K` (B, N), `air_K` by surrounding
    (B, M, 2).
    """

    parameter: int = -1
    pairs: list[tuple[Array, Array]] = field(default_factory=list)
    ratio: Array | None = None  # (N,) dC/C per cell
    start_K: Array | None = None
    air_K: dict[int, Array] = field(default_factory=dict)

    @property
    def thermal(self) -> bool:
        return bool(self.pairs or self.air_K) or self.ratio is not None or self.start_K is not None


class UnknownsOf:
    """Builds the unknowns of one solved parameter set; `cells_degC` (B, M + 1, N) at all borders.

    A series of temperatures is a straight line whose mean over the interval is right, not one through the borders:
    that makes the derivatives of a linear network accurate to the fourth order in the interval.
    """

    def __init__(self, solved: Solved, cells_degC: Array) -> None:
        self.solved, self.balance, self.cells_degC = solved, solved.balance, cells_degC
        self.network, self.values = solved.balance.network, solved.balance.values
        self.bulge_K = bulge_K(solved, cells_degC[None])[0]
        self.shape = (*self.balance.inputs.valid.shape, 2)
        self.edges, self.heats = _by_parameter(self.network)

    def parameter(self, j: int) -> Unknown:
        """By a parameter's value, in its own unit."""
        out = Unknown(parameter=j)
        self._capacities(out, j)
        for edge in self.edges[j]:
            self._edge(out, edge, j)
        self._heats(out, j)
        self._surroundings(out, j)
        if any(j in law.parameters.values() for law, _ in self.network.starts):
            excess = excess_K(self.network, stepped(self.values, j), self.balance.inputs)
            out.start_K = None if excess is None else np.imag(excess[0]) / STEP
        return out

    def start(self, cells: NDArray[np.int64]) -> Unknown:
        """By the start temperature of a body, each batch its own."""
        start_K = np.zeros((self.shape[0], self.network.n_cells))
        start_K[:, cells] = 1.0
        return Unknown(start_K=start_K)

    def offset(self, s: int) -> Unknown:
        """By an offset of a surrounding, each batch its own."""
        out = Unknown()
        self._warmer(out, s, np.ones(self.shape))
        return out

    def _capacities(self, out: Unknown, j: int) -> None:
        if not any(j == k for c in self.network.capacities for k, _ in c.powers):
            return
        slopes = np.array([c.slope(self.values, j)[0] for c in self.network.capacities])
        out.ratio = slopes / self.balance.capacity_J_per_K[0]
        conductance = self.balance.conductance_W_per_K[0]
        for i in np.flatnonzero(slopes):
            rise = self._series(np.eye(self.network.n_cells)[i]) - self.cells_degC[:, :1, i, None]
            out.pairs.append((conductance[:, i] * out.ratio[i], rise))

    def _edge(self, out: Unknown, edge: Edge, j: int) -> None:
        slope = edge_slope(self.balance, edge, j)
        own = self._series(edge.direction)
        lead = -own if edge.surrounding is None else self.balance.air.ends(edge.surrounding)[0] - own
        self._add(out, edge.direction, slope[..., None] * lead)

    def _heats(self, out: Unknown, j: int) -> None:
        sources = [s for s in (*self.solved.sources, *self.solved.asleep) if isinstance(s, HeatSource)]
        by_heat = {id(s.heat): s for s in sources}
        every = slice(0, self.shape[1])
        for heat in self.heats[j]:
            in_law = any(j in law.parameters.values() for law in (heat.law, *heat.factors))
            in_share = heat.direction_slope(j)
            for values in [stepped(self.values, j)] * in_law + [self.values] * bool(in_share.any()):
                if heat.temperature_dependent:
                    watts = np.moveaxis(by_heat[id(heat)].watts(self.borders, every, values), -2, -1)[0]
                else:
                    watts = self.balance.driven_W(heat, values)[0]
                if np.iscomplexobj(values):
                    self._add(out, heat.direction(self.values)[0], np.imag(watts) / STEP)
                else:
                    self._add(out, in_share, watts)

    @cached_property
    def borders(self) -> Borders:
        """What temperature-dependent heat sees."""
        if self.solved.coupled is not None:
            return self.solved.coupled.borders
        return Borders(np.moveaxis(self.cells_degC @ np.array(self.solved.places.rows).T, -1, 0)[:, None])

    def _surroundings(self, out: Unknown, j: int) -> None:
        inputs = self.balance.inputs
        for s, given in enumerate(self.network.surroundings):
            warmer = np.zeros(self.shape)
            constant = s not in self.balance.air.moving
            if follows(given, inputs) and given.value is not None and given.follow is not None:
                if given.value == j:
                    warmer += 1.0 - self.values[0, given.follow]
                if given.follow == j:
                    warmer += self.balance.air.recorded_degC[s] - self.values[0, given.value]
            elif constant and given.value == j:
                warmer += 1.0
            if given.offset == j:
                warmer += 1.0
            for law in given.effects:
                if j in law.parameters.values():
                    moved = effect_K(law, stepped(self.values, j), inputs, self.balance.air)
                    warmer += np.imag(moved[0]) / STEP
            if warmer.any():
                self._warmer(out, s, warmer)

    def _warmer(self, out: Unknown, s: int, warmer: Array) -> None:
        """A surrounding that is warmer by a series (B, M, 2): what regimes' constant conductances let in."""
        out.air_K[s] = warmer
        out.pairs.append((self.balance.into_W_per_K[0, :, s], warmer))

    def _series(self, place: Array) -> Array:
        """Temperature of a place at both ends of every interval (B, M, 2), shifted so that its mean is right."""
        borders = self.cells_degC @ place
        return np.stack([borders[:, :-1], borders[:, 1:]], axis=-1) + (self.bulge_K @ place)[..., None]

    def _add(self, out: Unknown, direction: Array, series: Array) -> None:
        out.pairs.append((np.repeat(direction[None], self.balance.regimes.count, axis=0), series))


def _by_parameter(network: Network) -> tuple[dict[int, list[Edge]], dict[int, list[Heat]]]:
    """The edges and the heats that each parameter changes, by its number."""
    edges: dict[int, list[Edge]] = defaultdict(list)
    heats: dict[int, list[Heat]] = defaultdict(list)
    for edge in network.edges:
        laws = [network.factors[k] for k in edge.factors]
        for j in {k for k, _ in edge.conductance.powers}.union(*(law.parameters.values() for law in laws)):
            edges[j].append(edge)
    for heat in network.heats:
        if heat.asleep:  # its twin that is awake has the other parameters
            for j in {k for law in (heat.law, *heat.factors) if law.asleep for k in law.parameters.values()}:
                heats[j].append(heat)
            continue
        shares = {o.share for o in heat.outlets if o.share is not None}
        for j in shares.union(*(law.parameters.values() for law in (heat.law, *heat.factors))):
            heats[j].append(heat)
    return edges, heats


def edge_slope(balance: Balance, edge: Edge, j: int) -> Array:
    """Derivative (B, M) of an edge's conductance in every interval by parameter j's value."""
    laws = [balance.network.factors[k] for k in edge.factors]
    values = stepped(balance.values, j)
    out = np.asarray(edge.conductance(values))[0] * np.ones(balance.inputs.valid.shape)
    for k, law in zip(edge.factors, laws, strict=True):
        if k in balance.regimes.varying or j in law.parameters.values():
            out = out * factor_series(law, values, balance.inputs)[0]
        else:
            out = out * balance.regimes.factor[0, balance.regimes.of, k]
    return np.asarray(np.imag(out) / STEP)


def few(pairs: Sequence[tuple[Array, Array]], n_cells: int) -> list[tuple[Array, Array]]:
    """The same heat in at most as many pairs as there are cells."""
    if len(pairs) <= n_cells:
        return list(pairs)
    n_regimes = len(pairs[0][0])
    if any((d != d[0]).any() for d, _ in pairs):
        return list(pairs)
    directions = np.array([d[0] for d, _ in pairs])
    total = np.einsum("jn,jbme->nbme", directions, np.array([s for _, s in pairs]))
    return [(np.repeat(unit[None], n_regimes, axis=0), total[i]) for i, unit in enumerate(np.eye(n_cells))]


class Answer:
    """y of a linear network to heat ``w = slope (seen + y) + given`` of k sources, at outputs `matrix` (n_out, N).

    The sources look at the first n outputs, with `slope` (B, M, 2, k, n), W/K, at both ends of every interval.
    """

    def __init__(self, solved: Solved, matrix: Array, slope: Array) -> None:
        balance, modes = solved.balance, solved.response.modes
        schedule, valid = balance.schedule, balance.inputs.valid
        self.matrix, self.slope = matrix, slope
        kind = np.where(valid, schedule.regime * len(schedule.step_s) + schedule.step, -1)
        kinds, number = np.unique(kind, return_inverse=True)
        self.number = number.reshape(kind.shape)  # of each interval's regime and step
        regime, dt_s = kinds // len(schedule.step_s), schedule.step_s[kinds % len(schedule.step_s), None]
        decay, start_s, end_s = first_order_hold(modes.rate_per_s[0, regime], dt_s * (kinds >= 0)[:, None])
        shape = modes.shape[0, regime]
        modal = (outlets(balance, solved.sources)[0, regime] @ shape).swapaxes(-1, -2)
        self.keeps = (shape * decay[:, None]) @ modes.inverse[0, regime]  # (kinds, N, N); behind the end all of it
        self.of_start = shape @ (start_s[..., None] * modal)  # (kinds, N, k)
        self.of_end = shape @ (end_s[..., None] * modal)
        loop = slope[:, :, 1] @ (matrix[: slope.shape[-1]] @ self.of_end)[self.number]
        self.solution = np.linalg.inv(np.eye(loop.shape[-1]) - loop)  # (B, M, k, k)

    def run(self, part: slice, seen: Array, given: Array, now: Array, every: int = 1) -> tuple[Array, Array]:
        """Outputs and, at the end, all cells of y from its cells `now` (B, N, Q) at the start of some intervals.

        Time goes first: seen (m + 1, B, n, Q), given (m, 2, B, k, Q), outputs (m // every + 1, B, n_out, Q).
        """
        n_seen, shown = seen.shape[2], self.matrix @ now
        out = np.empty(((part.stop - part.start) // every + 1, *shown.shape))
        out[0] = shown
        for i, m in enumerate(range(part.start, part.stop)):
            number = self.number[:, m]
            start_W = self.slope[:, m, 0] @ (seen[i] + shown[:, :n_seen]) + given[i, 0]
            ahead = self.keeps[number] @ now + self.of_start[number] @ start_W
            known_W = self.slope[:, m, 1] @ (seen[i + 1] + self.matrix[:n_seen] @ ahead) + given[i, 1]
            now = ahead + self.of_end[number] @ (self.solution[:, m] @ known_W)
            shown = self.matrix @ now
            if (i + 1) % every == 0:
                out[(i + 1) // every] = shown
        return out, now
