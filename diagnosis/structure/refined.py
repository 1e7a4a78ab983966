"""Refined twins: every lump of a network cut into a chain or web of cells, with everything attached at random cells.

A lumped network says nothing about the inside of its bodies, so neither does a prior: total capacities, links, films
and heats are the network's own; how a casting conducts inside, where its neighbours touch it, where a heat enters,
where a sensor stands and what an error chain spans are drawn. The misfit of the lump to such a machine has a shape
that the inputs and sensors of this machine determine (model discrepancy, Kennedy and O'Hagan 2001, J. R. Stat. Soc. B
63, 425; here simulated instead of a generic process).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError, WorkError
from diagnosis.structure.policy import STRUCTURE
from diagnosis.structure.rows import Rows
from twin.calibration.problem import CalibrationProblem
from twin.network import Edge, Heat, Law, Network, Port
from twin.quantity import Monomial
from twin.simulation import simulate

Style = Literal["chain", "web"]
Pairs = list[tuple[int, int]]


def _chain(cells: int, rng: np.random.Generator) -> Pairs:
    return [(k, k + 1) for k in range(cells - 1)]


def _web(cells: int, rng: np.random.Generator) -> Pairs:
    """A random tree with a few more connections."""
    tree = [(int(rng.integers(0, k)), k) for k in range(1, cells)]
    pairs = [tuple(sorted(rng.choice(cells, 2, replace=False).tolist())) for _ in range(max(0, cells - 3))]
    return list(dict.fromkeys([*tree, *((a, b) for a, b in pairs)]))


STYLES: Mapping[Style, Callable[[int, np.random.Generator], Pairs]] = {"chain": _chain, "web": _web}


@dataclass(frozen=True)
class Cut:
    """Which of the N cells of a network are cut into how many (N,), and how large the M pieces are.

    `parent` (M,) is the cell that a piece belongs to, `first` (N,) the number of a cell's first piece, `share` (M,) of
    its capacity.
    """

    pieces: NDArray[np.int64]
    parent: NDArray[np.int64]
    first: NDArray[np.int64]
    share: Array
    rng: np.random.Generator

    @classmethod
    def drawn(cls, network: Network, rng: np.random.Generator) -> Cut:
        """Bodies of one cell that exchange heat with something; what is cut already stays as it is."""
        joined = np.any([e.direction != 0 for e in network.edges], axis=0) if network.edges else np.zeros(0, bool)
        lump = np.zeros(network.n_cells, bool)
        lump[[cells[0] for cells in network.bodies.values() if len(cells) == 1]] = True
        low, high = STRUCTURE.refined_cells
        pieces = np.where(joined & lump, rng.integers(low, high + 1, network.n_cells), 1)
        share = [rng.dirichlet(np.full(n, STRUCTURE.piece_evenness)) if n > 1 else np.ones(1) for n in pieces]
        return cls(
            pieces, np.repeat(np.arange(len(pieces)), pieces), np.cumsum(pieces) - pieces, np.concatenate(share), rng
        )

    def at_one(self, weights: Array) -> Array:
        """Weights (N,) of cells, each put at one piece (M,): a sensor, a contact."""
        out = np.zeros(len(self.parent))
        for k in np.flatnonzero(weights):
            out[self.first[k] + int(self.rng.integers(self.pieces[k]))] += weights[k]
        return out

    def spread(self, weights: Array) -> Array:
        """Weights (N,) of cells, each spread unevenly over the pieces (M,): a heat, a length, a film."""
        out = np.zeros(len(self.parent))
        for k in np.flatnonzero(weights):
            at = slice(self.first[k], self.first[k] + self.pieces[k])
            out[at] += weights[k] * self.rng.dirichlet(np.ones(self.pieces[k]))
        return out


def refined(
    network: Network, values: Array, style: Style, biot: tuple[float, float], rng: np.random.Generator
) -> tuple[Network, Cut]:
    """A network with the same parameters (n,) whose lumps are cut; `values` say how much heat leaves each body.

    The conductance inside a body is what leaves it over a Biot number that is drawn for the machine and scattered
    between its bodies: castings are soft against their joints, a board's heater is not.
    """
    cut = Cut.drawn(network, rng)
    leaves = np.diagonal(network.conductance_W_per_K(values))
    low, high = np.log(biot)
    softness = np.exp(rng.uniform(low, high))
    edges = [piece for edge in network.edges for piece in _attached(edge, cut)]
    for k in np.flatnonzero(cut.pieces > 1):
        through = leaves[k] / (softness * np.exp(STRUCTURE.biot_log_sd * rng.standard_normal()))
        for one, other in STYLES[style](int(cut.pieces[k]), rng):
            direction = np.zeros(len(cut.parent))
            direction[cut.first[k] + one], direction[cut.first[k] + other] = 1.0, -1.0
            inside = through * (cut.pieces[k] - 1) * np.exp(STRUCTURE.joint_log_sd * rng.standard_normal())
            edges.append(Edge(f"inside {network.cells[k]}", direction, Monomial(float(inside))))
    return _on_pieces(network, cut, edges), cut


def _attached(edge: Edge, cut: Cut) -> list[Edge]:
    """A joint between single pieces; a film in parts, one at every piece of its body."""
    places = np.flatnonzero(edge.direction)
    if edge.surrounding is None or len(places) != 1 or cut.pieces[places[0]] == 1:
        return [replace(edge, direction=cut.at_one(edge.direction))]
    (k,) = places
    out = []
    for piece, share in enumerate(cut.rng.dirichlet(np.full(cut.pieces[k], 2.0))):
        direction = np.zeros(len(cut.parent))
        direction[cut.first[k] + piece] = edge.direction[k]
        out.append(replace(edge, direction=direction, conductance=edge.conductance.times(float(share))))
    return out


def _on_pieces(network: Network, cut: Cut, edges: list[Edge]) -> Network:
    """The network with other edges, and everything that refers to cells put on their pieces."""

    def port(p: Port) -> Port:
        return p if p.cells is None else replace(p, cells=cut.spread(p.cells))

    def law(w: Law) -> Law:
        return replace(w, ports={name: port(p) for name, p in w.ports.items()})

    def heat(h: Heat) -> Heat:
        outlets = tuple(replace(o, cells=cut.spread(o.cells)) for o in h.outlets)
        taken = None if h.taken is None else cut.spread(h.taken)
        return replace(h, law=law(h.law), factors=tuple(map(law, h.factors)), outlets=outlets, taken=taken)

    return replace(
        network,
        cells=tuple(f"{network.cells[k]} {n}" for n, k in enumerate(cut.parent)),
        bodies={
            name: np.concatenate([cut.first[k] + np.arange(cut.pieces[k]) for k in cells])
            for name, cells in network.bodies.items()
        },
        capacities=tuple(
            network.capacities[k].times(float(w)) for k, w in zip(cut.parent, cut.share, strict=True)
        ),
        edges=tuple(edges),
        factors=tuple(map(law, network.factors)),
        heats=tuple(map(heat, network.heats)),
        starts=tuple((law(w), cells[cut.parent]) for w, cells in network.starts),
        readings=tuple(
            replace(r, cells=cut.at_one(r.cells), effects=tuple(map(law, r.effects))) for r in network.readings
        ),
        errors=tuple(
            replace(
                e,
                rows=np.array([cut.spread(row) for row in e.rows]).reshape(len(e.rows), len(cut.parent)),
                effects=tuple(map(law, e.effects)),
                readings=tuple(map(law, e.readings)),
            )
            for e in network.errors
        ),
    )  # fmt: skip


def misfits(
    problem: CalibrationProblem,
    values: Array,
    nuisance: list[Array],
    style: Style,
    biot: tuple[float, float],
    machines: int,
    seed: int,
) -> Array:
    """What refined machines show beyond the lumped network at the same parameter values, in units of the given noise.

    Args:
        values: (n,) parameter values of the network.
        nuisance: of every batch its own unknowns: starts and offsets.
        biot: range of the Biot number of bodies against what they exchange heat with.

    Returns:
        (rows, machines) in the order of `Rows`; a machine that cannot be simulated is left out.
    """
    inputs, start = problem.own(nuisance)
    rows = Rows.of(problem)
    lumped = _shown(problem.network, values, inputs, start)
    out = []
    for k in range(machines):
        rng = np.random.default_rng([seed, k])
        network, cut = refined(problem.network, values, style, biot, rng)
        try:
            more = _shown(network, values, inputs, start[:, :, cut.parent]) - lumped
        except (InputError, WorkError):
            continue
        if np.isfinite(more).all():
            parts = [m.of(more[b]) / problem.noise[m.channel] for b, m in enumerate(problem.measured)]
            out.append(np.concatenate(parts))
    return np.array(out).T if out else np.zeros((rows.n, 0))


def _shown(network: Network, values: Array, inputs: object, start_degC: Array) -> Array:
    """All channels (B, K, C) of one simulation."""
    run = simulate(network, values, inputs, start_degC)  # type: ignore[arg-type]
    return np.concatenate([run.readings[0], run.errors[0]], axis=-1)
