"""Heat flows of a simulation: heat by law, storage by body, losses by surrounding, flow through links.

All are means over the intervals between two rows, so that energies add up. Heat and storage follow exactly from the
simulation, J. Exchange needs the integral of the cells' temperatures: it follows from the balance itself, ``K ∫T = ∫q +
G_s ∫T_s - C ΔT`` with the conductances of the interval's regime, and from the trapezoid of the rows in the null space
of K (a closed network). Surroundings are linear in an interval: their trapezoid is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError, closest
from twin.network import Edge, Network
from twin.simulation import Simulation
from twin.simulation.air import air_of
from twin.simulation.inputs import Inputs
from twin.simulation.schedule import regimes_of
from twin.views.overview import body_of

KINDS = ("heat", "storage", "loss", "link")
_BEYOND = " beyond its mean"  # the simulation's name for an edge's heat beyond its regime's constant
COLUMNS = ("batch", "start_s", "end_s", "kind", "name", "watts")


@dataclass(frozen=True)
class HeatFlows:
    """One batch of one parameter set, K rows; every flow has K - 1 mean watts.

    heat_W by law, storage_W by body, loss_W by surrounding, link_W by name of the link or exposure (+ from its first
    body to the second, or to the surrounding); rise_K by body (K,) from the batch's first row. At every interval the
    sum of heat is that of storage and losses.
    """

    batch_id: str
    simulated: bool
    time_s: Array
    heat_W: dict[str, Array]
    storage_W: dict[str, Array]
    loss_W: dict[str, Array]
    link_W: dict[str, Array]
    rise_K: dict[str, Array]

    @property
    def dt_s(self) -> Array:
        """Interval lengths (K - 1,)."""
        return np.diff(self.time_s)

    @property
    def gap_W(self) -> Array:
        """What does not close: heat less storage less losses, (K - 1,)."""
        return _sum(self.heat_W, self.dt_s) - _sum(self.storage_W, self.dt_s) - _sum(self.loss_W, self.dt_s)

    def table(self) -> pd.DataFrame:
        """Every flow over time, long: `COLUMNS`."""
        parts = []
        for kind, flows in zip(KINDS, (self.heat_W, self.storage_W, self.loss_W, self.link_W), strict=True):
            for name, watts in flows.items():
                given = (self.batch_id, self.time_s[:-1], self.time_s[1:], kind, name, watts)
                parts.append(pd.DataFrame(dict(zip(COLUMNS, given, strict=True))))
        return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(COLUMNS))

    def totals(self) -> pd.DataFrame:
        """Over the whole batch: kind, name, energy_kJ, mean_W, and share of all heat put in."""
        duration_s = float(self.time_s[-1] - self.time_s[0])
        rows = []
        for kind, flows in zip(KINDS, (self.heat_W, self.storage_W, self.loss_W, self.link_W), strict=True):
            rows += [(kind, name, float(watts @ self.dt_s)) for name, watts in flows.items()]
        put_in = sum(max(joules, 0.0) for kind, _, joules in rows if kind == "heat")
        return pd.DataFrame(
            [(k, n, j / 1e3, j / duration_s, j / put_in if put_in > 0 else np.nan) for k, n, j in rows],
            columns=["kind", "name", "energy_kJ", "mean_W", "share"],
        )


def heat_flows(simulation: Simulation, inputs: Inputs, batch: int | str = 0) -> HeatFlows:
    """The flows of one batch of a simulation at the network's own values, with its cells kept.

    `inputs` are those of the simulation. The flows count as simulated also with recorded drivers, since every watt is
    computed.

    Raises:
        InputError: no cells kept, other inputs than the simulation's, an unknown batch, or conductances that change
            between two rows (simulate with inputs of `every` 1).
    """
    network = simulation.network
    b, every = _fits(simulation, inputs, batch)
    p = np.atleast_2d(network.values)
    one = inputs.batch([b])
    k = int(one.n_intervals[0]) // every + 1
    regimes = regimes_of(network, p, one)
    regime = _regime(regimes.of[0, : (k - 1) * every].reshape(k - 1, every), simulation.batch_ids[b])
    factor = regimes.factor[0]  # (R, F)
    air = air_of(network, p, one)
    dt_s = one.dt_s[0, : (k - 1) * every]
    grouped, n_air = (k - 1, every), len(network.surroundings)
    air_Ks = np.array(
        [(air.ends(s)[0, 0, : (k - 1) * every].mean(-1) * dt_s).reshape(grouped).sum(-1) for s in range(n_air)]
    ).reshape(n_air, k - 1)
    assert simulation.cells_degC is not None
    cells = simulation.cells_degC[0, b, :k]
    joules = {name: np.diff(j[0, b, :k]) for name, j in simulation.heat_J.items()}
    stored_J = network.capacity_J_per_K(p[0]) * np.diff(cells, axis=0)
    spans_s = dt_s.reshape(grouped).sum(-1)
    cells_Ks = _integrals(network, p, factor, regime, cells, spans_s, air_Ks, joules, stored_J)
    left_J = _exchange(network, p[0], factor, regime, cells_Ks, air_Ks, joules)
    loss = {s.name: np.zeros(k - 1) for s in network.surroundings}
    link: dict[str, Array] = {}
    for e, left in zip(network.edges, left_J, strict=True):
        if e.surrounding is not None:
            loss[network.surroundings[e.surrounding].name] += left / spans_s
        if e.surrounding is not None or not _within(network, e):
            link[e.name] = link.get(e.name, 0.0) + left / spans_s
    rise = cells - cells[0]
    return HeatFlows(
        simulation.batch_ids[b],
        True,
        simulation.time_s[b, :k],
        {h.law.name: joules[h.law.name] * h.direction(p[0]).sum() / spans_s for h in network.heats},
        {name: stored_J[:, c].sum(axis=1) / spans_s for name, c in network.bodies.items()},
        loss,
        link,
        {name: rise[:, c].mean(axis=1) for name, c in network.bodies.items()},
    )


def _fits(simulation: Simulation, inputs: Inputs, batch: int | str) -> tuple[int, int]:
    """Number of the batch and intervals per row."""
    machine = simulation.network.machine
    if simulation.cells_degC is None:
        raise InputError(f"machine {machine}: the simulation kept no cells; simulate with keep_cells=True")
    if isinstance(batch, str):
        if batch not in simulation.batch_ids:
            raise InputError(f"machine {machine}: no batch {batch!r}; {closest(batch, simulation.batch_ids)}")
        batch = simulation.batch_ids.index(batch)
    rows, borders = simulation.time_s.shape[1], inputs.time_s.shape[1]
    every = (borders - 1) // max(rows - 1, 1)
    if inputs.batch_ids != simulation.batch_ids or not np.array_equal(inputs.time_s[:, ::every], simulation.time_s):
        raise InputError(f"machine {machine}: these inputs are not the simulation's; give those that it was made from")
    return batch, every


def _regime(of: NDArray[np.int64], batch_id: str) -> NDArray[np.int64]:
    if (of != of[:, :1]).any():
        raise InputError(f"batch {batch_id}: conductances change between two rows; simulate with inputs of every=1")
    return of[:, 0]


def _integrals(
    network: Network,
    values: Array,
    factor: Array,
    regime: NDArray[np.int64],
    cells_degC: Array,
    spans_s: Array,
    air_Ks: Array,
    joules: dict[str, Array],
    stored_J: Array,
) -> Array:
    """Integrals of the cells' temperatures over every interval, (K - 1, N) in K s."""
    q = np.zeros_like(stored_J)
    for h in network.heats:
        q += joules[h.law.name][:, None] * h.direction(values[0])
    for e in network.edges:  # exchange that varies within a regime is heat on top of the regime's constant
        if _varies(network, e, joules):
            q += joules[e.name + _BEYOND][:, None] * e.direction
    out = 0.5 * (cells_degC[1:] + cells_degC[:-1]) * spans_s[:, None]
    for r in np.unique(regime):
        at = regime == r
        matrix = network.conductance_W_per_K(values, factor[None, r])[0]
        into = network.surrounding_W_per_K(values, factor[None, r])[0]
        missing = q[at] + air_Ks[:, at].T @ into - stored_J[at] - out[at] @ matrix
        out[at] += missing @ np.linalg.pinv(matrix, rcond=1e-13, hermitian=True)
    return np.asarray(out)


def _exchange(
    network: Network,
    values: Array,
    factor: Array,
    regime: NDArray[np.int64],
    cells_Ks: Array,
    air_Ks: Array,
    joules: dict[str, Array],
) -> Sequence[Array]:
    """Joules that leave along every edge in every interval, (K - 1,) each."""
    out = []
    for e in network.edges:
        g = np.array([float(network.edge_W_per_K(e, values, factor[r])) for r in range(len(factor))])[regime]
        driving = cells_Ks @ e.direction
        if e.surrounding is not None:
            driving = driving - air_Ks[e.surrounding]
        left = g * driving
        out.append(left - joules[e.name + _BEYOND] if _varies(network, e, joules) else left)
    return out


def _varies(network: Network, edge: Edge, joules: dict[str, Array]) -> bool:
    """Whether the simulation has an edge's heat beyond its regime's constant.

    Raises:
        InputError: it does for several edges of one name together: whose joules are whose is not known.
    """
    if edge.name + _BEYOND not in joules or not edge.factors:
        return False
    if sum(e.name == edge.name for e in network.edges) == 1:
        return True
    raise InputError(
        f"machine {network.machine}: the conductance of {edge.name} varies and {edge.name} reaches several cells; "
        "expose single places (body@0.5) to see its heat"
    )


def _within(network: Network, e: Edge) -> bool:
    """Whether both ends lie in one body."""
    return body_of(network, np.clip(e.direction, 0, None)) == body_of(network, np.clip(-e.direction, 0, None))


def _sum(flows: dict[str, Array], dt_s: Array) -> Array:
    return np.sum(list(flows.values()), axis=0) if flows else np.zeros(len(dt_s))
