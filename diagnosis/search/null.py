"""The structural null: gains of all candidates where nothing is missing, but the real network is finer."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError, WorkError
from data.files import source_digest, write_atomic
from diagnosis.candidates.discretisation import never_reported
from diagnosis.contracts import Candidate, Fitted
from diagnosis.policy import POLICY, Policy
from diagnosis.screening.evidence import Evidence
from diagnosis.screening.linearisation import difference
from diagnosis.screening.screen import alone, proposed, screens
from diagnosis.search.acceptance import balanced_quantile
from diagnosis.search.refits import common_memory
from twin.network import Network
from twin.quantity import Value
from twin.schema import Body, ErrorChain, MechanismPart, TwinPart


def refined(part: TwinPart, network: Network, values: np.ndarray, seed: int) -> TwinPart:
    """A random refinement of a fitted network at parameter values (n,); its parameters keep their names."""
    rng = np.random.default_rng(seed)
    total = network.conductance_W_per_K(values)
    bodies: dict[str, Body] = dict(part.bodies)
    linked = {place.partition("@")[0] for link in part.links.values() for place in link.between}
    for name, body in part.bodies.items():
        if body.shape != "lump" or name not in linked:
            continue
        (cell,) = network.bodies[name]
        biot = float(np.exp(rng.uniform(*np.log(POLICY.null_biot))))
        through = float(total[cell, cell]) / biot
        bodies[name] = body.model_copy(
            update={"shape": "bar", "cells": POLICY.null_cells, "conductance": Value(value=f"{through:.6g} W/K")}
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
    """The error chain with its lengths and levers attached at places in the bodies instead of their means."""

    def place(at: str) -> str:
        return f"{at}@{rng.uniform(*POLICY.null_length_centre):.3f}" if at in cut else at

    links = tuple(c.model_copy(update={"body": place(c.body)}) for c in chain.chain)
    tilts = tuple(t.model_copy(update={"hot": place(t.hot), "cold": place(t.cold)}) for t in chain.tilts)
    return chain.model_copy(update={"chain": links, "tilts": tilts})


def _placed(given: MechanismPart, cut: set[str], rng: np.random.Generator) -> MechanismPart:
    """The mechanism with its heat into a place of the body; fitted shares keep their names."""

    def place(at: str) -> str:
        return f"{at}@{rng.uniform(0.0, 1.0):.3f}" if at in cut else at

    if isinstance(given.into, str):
        return given.model_copy(update={"into": place(given.into)})
    if isinstance(given.into, Mapping):
        into = {place(k) if v == "rest" else k: v for k, v in given.into.items()}
        return given.model_copy(update={"into": into})
    return given


@dataclass(frozen=True)
class Null:
    """Gains on recordings of T refined machines with the misfit at S scales, where no candidate is at work.

    Attributes:
        gain: (T, S) the largest of any candidate, in nats.
        density: (T, S) log density of batches left out, without a candidate.
        mean_squares: (T, S, K) left-out mean squares by channel, in units of the given noise's variance.
        amplitude: (T, S, C) of each candidate.
        names: of the C candidates.
        gains: (T, S, C) of each candidate, in nats.
    """

    gain: Array
    density: Array
    mean_squares: Array
    amplitude: Array
    names: tuple[str, ...] = ()
    gains: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))

    def threshold(
        self, density: float, share: float = POLICY.chance_quantile, name: str = "", margin: float = POLICY.null_margin
    ) -> float:
        """The gain in nats that structure alone exceeds with probability 1 - share, times `margin`.

        Of each machine counts the largest misfit that predicts left-out batches no worse than `density`, the log
        density of the recordings. The quantile is that of a Gumbel distribution, as machines are few. With the `name`
        of a candidate it is the quantile of its own gains (`balanced_quantile`), else of the largest gain of all.
        """
        gain = self.typical(density)
        if len(gain) < POLICY.null_min_machines:
            return float("inf")
        if name not in self.names or not self.gains.size:
            return margin * balanced_quantile(gain[:, None], None, share)
        return margin * balanced_quantile(
            self.gains[np.arange(len(gain)), self._scale(density)], self.names.index(name), share
        )

    def typical(self, density: float) -> Array:
        """The largest gain (T,) of each machine at the misfit that `density` allows."""
        return np.asarray(self.gain[np.arange(len(self.gain)), self._scale(density)])

    @property
    def temperature(self) -> float:
        """Nats of score that count as one when explanations are compared: a share of the median null gain."""
        typical = self.typical(self.as_it_is)
        return (
            float(np.clip(POLICY.temperature_null_share * np.median(typical), *POLICY.temperature_bounds_nats))
            if self.gain.size
            else POLICY.temperature_bounds_nats[0]
        )

    @property
    def as_it_is(self) -> float:
        """Median log density at the scale at which the misfit is that of the refined machines."""
        return (
            float(np.median(self.density[:, min(POLICY.null_own_scale, self.density.shape[1] - 1)]))
            if self.density.size
            else 0.0
        )

    def scatter(self, name: str, density: float) -> float:
        """By how much structure and noise move a candidate's amplitude in nine of ten machines, in its unit.

        0 where that is not known. Misfits count as in `threshold`. Of an amplitude that cannot be negative only one
        side shows, so that one machine in twenty goes beyond.
        """
        if name not in self.names or len(self.gain) < 2:
            return 0.0
        own = self.amplitude[np.arange(len(self.gain)), self._scale(density), self.names.index(name)]
        quantile = POLICY.amplitude_scatter_quantile
        quantile = quantile if (own < 0).any() else (1.0 + quantile) / 2.0
        return POLICY.amplitude_scatter_factor * float(np.quantile(np.abs(own), quantile))

    def _scale(self, density: float) -> NDArray[np.int64]:
        """The scale (T,) of the largest misfit of each machine that predicts left-out batches no worse."""
        allowed = self.density >= density
        last = allowed.shape[1] - 1 - np.argmax(allowed[:, ::-1], axis=1)
        return np.where(allowed.any(axis=1), last, 0)


def structural_null(
    fitted: Fitted,
    evidence: Evidence,
    counts: Mapping[str, int],
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    policy: Policy = POLICY,
) -> Null:
    """Left-out gains on recordings of refined machines that are driven as the given recordings were.

    Only the targets change: the linearisation, its factors and the folds are those of `evidence`. `counts` gives the
    columns, by candidate, whose gain would be an alarm. Parameters are drawn from the machine file's priors and not
    taken from the fit: a fit that is bent by what is missing would let candidates gain by bending it back.
    """
    drawn = recordings(structural_misfits(fitted, seed, progress), evidence, seed)
    left_out = policy.leaves_batches_out
    gain, amplitude, _ = evidence.gains(drawn, left_out)
    columns = list(counts.values())
    squares = evidence.mean_squares(evidence.residuals(drawn, left_out))
    shape = (-1, len(POLICY.null_scales))
    return Null(
        gain[:, columns].max(axis=1, initial=0.0).reshape(shape),
        evidence.base_score(drawn, left_out).reshape(shape),
        squares.reshape(*shape, squares.shape[1]),
        amplitude[:, columns].reshape(*shape, len(columns)),
        tuple(counts),
        gain[:, columns].reshape(*shape, len(columns)),
    )


def structural_misfits(
    fitted: Fitted, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> list[list[Array]]:
    """What each refined machine shows beyond the fit, (n_b,) of every batch in units of the given noise."""
    base = fitted.problem.residuals(fitted.x, fitted.state.nuisance)
    out = []
    for k in range(POLICY.null_machines):
        try:
            part = refined(fitted.part, fitted.problem.network, fitted.values, seed + k)
            out.append(difference(fitted, part, base))
        except (InputError, WorkError):
            continue  # a draw that no machine has
        if progress:
            progress(k + 1, POLICY.null_machines)
    return out


def recordings(misfits: Sequence[Sequence[Array]], evidence: Evidence, seed: int = 0) -> list[Array]:
    """Targets (n_b, T S) of every batch: T machines with parameters of their own, each at every scale, and noise."""
    rng = np.random.default_rng(seed)
    targets: list[list[Array]] = [[] for _ in evidence.batches]
    for rows in misfits:
        z = rng.standard_normal(evidence.batches[0].jacobian.shape[1])
        for own, whitened, misfit in zip(targets, evidence.batches, rows, strict=True):
            plain, noise = whitened.jacobian @ z, rng.standard_normal(len(misfit))
            own += [plain + whitened.of(scale * misfit + noise) for scale in POLICY.null_scales]
    return [np.stack(t, axis=1) for t in targets]


TINY = 1e-12


def null_with(
    before: Fitted, after: Fitted, c: Candidate, seed: int, policy: Policy = POLICY
) -> tuple[Null, float] | None:
    """The null at the fit with the candidate `c`, and the log density of batches left out there.

    Amplitudes of `c` are in its own unit. None where `c` adds no amplitude to the fit: a doubted value, swapped labels.
    """
    own = _sizes(before, after, c)
    if not own:
        return None
    every = proposed(after)
    memory = common_memory([after], policy)
    (seen,), loose = screens(after, every, [memory]), never_reported(every, after)
    evidence = _as_column(seen.evidence, after, own)
    columns = seen.columns({*loose, c.name})
    columns[c.name] = evidence.batches[0].columns.shape[1] - 1
    density = alone(after, memory).base_score(left_out=policy.leaves_batches_out)
    return structural_null(after, evidence, columns, seed, policy=policy), float(density[0])


def _sizes(before: Fitted, after: Fitted, c: Candidate) -> list[int]:
    """Numbers of the unknowns that the candidate added, without those of its shape."""
    if c.part is None or not c.kind.is_physics:
        return []
    known = {u.name for u in before.problem.unknowns}
    new = [k for k, u in enumerate(after.problem.unknowns) if u.name not in known]
    return [k for k in new if after.problem.unknowns[k].name.rpartition(".")[2] not in c.shape]


def _as_column(evidence: Evidence, after: Fitted, own: list[int]) -> Evidence:
    """The evidence with the largest of these unknowns as a further column, per unit of its value, and none of them as a
    parameter."""
    unknowns, network = after.problem.unknowns, after.problem.network
    value = {k: float(after.values[network.index(unknowns[k].name)]) for k in own}
    norm = {k: sum(float(b.jacobian[:, k] @ b.jacobian[:, k]) for b in evidence.batches) for k in own}
    most = max(own, key=lambda k: norm[k])
    slope = {"log": value[most], "logit": value[most] * (1.0 - value[most])}.get(unknowns[most].scale, 1.0)
    unit = unknowns[most].spread * max(slope, TINY)
    batches = tuple(
        replace(
            b,
            jacobian=np.delete(b.jacobian, own, axis=1),
            columns=np.column_stack([b.columns, b.jacobian[:, most] / unit]),
        )
        for b in evidence.batches
    )
    bound = POLICY.null_amplitude_bound_factor * max(abs(value[most]), TINY)
    low = -bound if unknowns[most].scale == "linear" else 0.0
    return replace(evidence, batches=batches, low=np.append(evidence.low, low), high=np.append(evidence.high, bound))


CACHED_NULLS = 64  # nulls in a folder; the oldest go


def cached_null(
    folder: Path | None,
    fitted: Fitted,
    evidence: Evidence,
    counts: Mapping[str, int],
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Null:
    """`structural_null`, read from `folder` if it holds that of the same inputs, else computed and written there.

    A file that cannot be read counts as missing; a folder that cannot be written keeps nothing.
    """
    if folder is None:
        return structural_null(fitted, evidence, counts, seed, progress)
    path = folder / f"null-{_key(fitted, evidence, counts, seed)}.npz"
    null = _read(path, tuple(counts))
    if null is None:
        null = structural_null(fitted, evidence, counts, seed, progress)
        _write(path, null)
    return null


def _key(fitted: Fitted, evidence: Evidence, counts: Mapping[str, int], seed: int) -> str:
    digest = hashlib.sha256()
    for text in _words(fitted, counts, seed):
        digest.update(f"{len(text)}:{text};".encode())
    for array in _numbers(fitted, evidence):
        digest.update(f"{array.shape}{array.dtype};".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _words(fitted: Fitted, counts: Mapping[str, int], seed: int) -> Iterator[str]:
    yield source_digest("data", "twin", "diagnosis")
    yield np.__version__
    yield f"{seed} {POLICY}"
    yield fitted.machine.machine
    yield fitted.part.model_dump_json()
    yield from (f"{name} {column}" for name, column in counts.items())


def _numbers(fitted: Fitted, evidence: Evidence) -> Iterator[np.ndarray]:
    """All inputs of a null; sums stand for the evidence's rows."""
    inputs, state = fitted.problem.inputs, fitted.state
    yield from (inputs.time_s, inputs.n_intervals, inputs.clock_h, *inputs.drivers.values(), *inputs.recorded.values())
    yield from (fitted.values, *state.nuisance, fitted.noise.factor, fitted.memory.share, fitted.memory.keep)
    for m in fitted.problem.measured:
        yield from (m.row, m.channel, m.value)
    yield from (evidence.rows, evidence.weight, evidence.low, evidence.high)
    for b in evidence.batches:
        yield from (b.target, b.jacobian.sum(axis=0), b.columns.sum(axis=0))


def _read(path: Path, names: tuple[str, ...]) -> Null | None:
    try:
        with np.load(BytesIO(path.read_bytes()), allow_pickle=False) as kept:
            arrays = {f.name: kept[f.name] for f in fields(Null)}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    if tuple(arrays.pop("names").tolist()) != names or arrays["gain"].ndim != 2:
        return None
    return Null(**arrays, names=names)


def _write(path: Path, null: Null) -> None:
    arrays = {f.name: np.asarray(getattr(null, f.name)) for f in fields(Null)}
    file = BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, file.getvalue())
        kept = sorted(path.parent.glob("null-*.npz"), key=lambda p: p.stat().st_mtime, reverse=True)
        for old in kept[CACHED_NULLS:]:
            old.unlink(missing_ok=True)
    except OSError:  # it is computed again next time
        return
