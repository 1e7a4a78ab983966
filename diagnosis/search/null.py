"""The structural null: what the whole search would find where nothing is missing but a finer network."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from importlib.metadata import PackageNotFoundError, version
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError, WorkError
from data.files import write_atomic
from diagnosis.candidates.discretisation import no_news
from diagnosis.contracts import Candidate, Fitted
from diagnosis.screening.evidence import Evidence
from diagnosis.screening.linearisation import difference
from diagnosis.screening.screen import alone, proposed, screen
from diagnosis.search.acceptance import balanced
from twin.network import Network
from twin.quantity import Value
from twin.schema import Body, ErrorChain, MechanismPart, TwinPart

CELLS = 5
MIDDLE = (0.25, 0.75)  # where a length's mean temperature stands
BIOT = (0.03, 0.5)  # of a body: what leaves it per kelvin over what it conducts from end to end


def refined(part: TwinPart, network: Network, values: np.ndarray, seed: int) -> TwinPart:
    """A random finer twin of a fitted network at parameter values (n,); same parameters by the same names."""
    rng = np.random.default_rng(seed)
    total = network.conductance_W_per_K(values)
    bodies: dict[str, Body] = dict(part.bodies)
    linked = {place.partition("@")[0] for link in part.links.values() for place in link.between}
    for name, body in part.bodies.items():
        if body.shape != "lump" or name not in linked:
            continue
        (cell,) = network.bodies[name]
        biot = float(np.exp(rng.uniform(*np.log(BIOT))))
        through = float(total[cell, cell]) / biot
        bodies[name] = body.model_copy(
            update={"shape": "bar", "cells": CELLS, "conductance": Value(value=f"{through:.6g} W/K")}
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
    """An error whose lengths and levers end somewhere in a body and not evenly over it."""

    def place(at: str) -> str:
        return f"{at}@{rng.uniform(*MIDDLE):.3f}" if at in cut else at

    links = tuple(c.model_copy(update={"body": place(c.body)}) for c in chain.chain)
    tilts = tuple(t.model_copy(update={"hot": place(t.hot), "cold": place(t.cold)}) for t in chain.tilts)
    return chain.model_copy(update={"chain": links, "tilts": tilts})


def _placed(given: MechanismPart, cut: set[str], rng: np.random.Generator) -> MechanismPart:
    """Heat into a place of its own; shares that are fitted keep the names that they go by."""

    def place(at: str) -> str:
        return f"{at}@{rng.uniform(0.0, 1.0):.3f}" if at in cut else at

    if isinstance(given.into, str):
        return given.model_copy(update={"into": place(given.into)})
    if isinstance(given.into, Mapping):
        into = {place(k) if v == "rest" else k: v for k, v in given.into.items()}
        return given.model_copy(update={"into": into})
    return given


TWINS = 14  # refined machines
# Bounds of the temperature: on development plants an explanation that was wrong led the true one by up to 28 nats.
HOT = 8.0, 16.0
SCALES = (0.3, 1.0, 3.0, 8.0)  # of the misfit of each: real castings are finer than bars of five cells
AS_IT_IS = 1  # the scale that is their own
MARGIN = 1.25  # on a quantile that so few machines tell
WIDER = 2.0  # an amplitude's scatter in plants of other numerics than in bars of five cells


@dataclass(frozen=True)
class Null:
    """Recordings of T refined machines with the misfit at S scales: largest gain of any candidate (T, S) in nats, the
    log density of batches left out (T, S) before any candidate, their mean squares (T, S, K), and the amplitudes and
    gains (T, S, C) that the candidates `names` would be given where none is there."""

    gain: Array
    density: Array
    mean_squares: Array
    amplitude: Array
    names: tuple[str, ...] = ()
    gains: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))

    def threshold(self, density: float, share: float = 0.99, name: str = "", margin: float = MARGIN) -> float:
        """The gain that structure alone exceeds in 1 - share of the cases, where it leaves no more than `density` says.

        Of each machine counts the largest misfit that predicts left-out batches no worse. As there are few, a Gumbel
        distribution goes through their mean and spread.

        With the `name` of a candidate what structure makes of it counts, and not of others (`balanced`).
        Either is `margin` times that quantile.
        """
        gain = self.typical(density)
        if len(gain) < 3:
            return float("inf")
        if name not in self.names or not self.gains.size:
            return margin * balanced(gain[:, None], None, share)
        return margin * balanced(self.gains[np.arange(len(gain)), self._scale(density)], self.names.index(name), share)

    def typical(self, density: float) -> Array:
        """The largest gain (T,) of each machine at that misfit."""
        return np.asarray(self.gain[np.arange(len(self.gain)), self._scale(density)])

    @property
    def temperature(self) -> float:
        """Nats of score that count as one when explanations are compared: a share of what structure alone gains."""
        typical = self.typical(self.as_it_is)
        return float(np.clip(np.median(typical) / 4.0, *HOT)) if self.gain.size else HOT[0]

    @property
    def as_it_is(self) -> float:
        """The usual log density where the misfit is that of the refined machines themselves."""
        return float(np.median(self.density[:, min(AS_IT_IS, self.density.shape[1] - 1)])) if self.density.size else 0.0

    def scatter(self, name: str, density: float) -> float:
        """By how much structure and noise move a candidate's amplitude in nine of ten machines; 0: that is not known.

        They leave no more than `density` says.

        An amplitude that cannot be negative shows half of that: of it one machine in twenty goes beyond.
        """
        if name not in self.names or len(self.gain) < 2:
            return 0.0
        own = self.amplitude[np.arange(len(self.gain)), self._scale(density), self.names.index(name)]
        return WIDER * float(np.quantile(np.abs(own), 0.9 if (own < 0).any() else 0.95))

    def _scale(self, density: float) -> NDArray[np.int64]:
        """Of each machine (T,) the largest misfit that predicts left-out batches no worse."""
        allowed = self.density >= density
        last = allowed.shape[1] - 1 - np.argmax(allowed[:, ::-1], axis=1)
        return np.where(allowed.any(axis=1), last, 0)


def structural_null(
    fitted: Fitted,
    evidence: Evidence,
    counts: Mapping[str, int],
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Null:
    """Refined machines driven as the recordings were, their left-out gains by the same evidence in one step each.

    Only the target changes: the linearisation, its factors and the folds are the recordings' own. `counts` numbers, by
    candidate, the columns whose gain would be an alarm. A machine's parameters are what the machine file thinks
    possible, not those of the fit: bent by what is missing, they would be what a candidate is rewarded for.
    """
    drawn = recordings(structural_misfits(fitted, seed, progress), evidence, seed)
    gain, amplitude, _ = evidence.gains(drawn)
    columns = list(counts.values())
    squares = evidence.mean_squares(evidence.left_out(drawn))
    shape = (-1, len(SCALES))
    return Null(
        gain[:, columns].max(axis=1, initial=0.0).reshape(shape),
        evidence.base_score(drawn).reshape(shape),
        squares.reshape(*shape, squares.shape[1]),
        amplitude[:, columns].reshape(*shape, len(columns)),
        tuple(counts),
        gain[:, columns].reshape(*shape, len(columns)),
    )


def structural_misfits(
    fitted: Fitted, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> list[list[Array]]:
    """Of each refined machine what it shows beyond the fit, (n_b,) of every batch in units of the given noise."""
    base = fitted.problem.residuals(fitted.x, fitted.state.nuisance)
    out = []
    for k in range(TWINS):
        try:
            part = refined(fitted.part, fitted.problem.network, fitted.values, seed + k)
            out.append(difference(fitted, part, base))
        except (InputError, WorkError):
            continue  # a draw that no machine has
        if progress:
            progress(k + 1, TWINS)
    return out


def recordings(misfits: Sequence[Sequence[Array]], evidence: Evidence, seed: int = 0) -> list[Array]:
    """Targets (n_b, T S) of every batch: T machines with parameters of their own, each at every scale, and noise."""
    rng = np.random.default_rng(seed)
    targets: list[list[Array]] = [[] for _ in evidence.batches]
    for rows in misfits:
        z = rng.standard_normal(evidence.batches[0].jacobian.shape[1])
        for own, whitened, misfit in zip(targets, evidence.batches, rows, strict=True):
            plain, noise = whitened.jacobian @ z, rng.standard_normal(len(misfit))
            own += [plain + whitened.of(scale * misfit + noise) for scale in SCALES]
    return [np.stack(t, axis=1) for t in targets]


TINY = 1e-12
FAR = 10.0  # times the size that was found: no machine without it is given more


def null_beside(before: Fitted, after: Fitted, c: Candidate, seed: int) -> tuple[Null, float] | None:
    """The null, with amplitudes of `c` in its own unit, and the log density of batches left out with `c`.

    None where `c` adds no size of its own to the fit: a value that is doubted, labels that are swapped.
    """
    own = _sizes(before, after, c)
    if not own:
        return None
    every = proposed(after)
    seen, loose = screen(after, every), no_news(every, after)
    evidence = _as_column(seen.evidence, after, own)
    columns = seen.columns({*loose, c.name})
    columns[c.name] = evidence.batches[0].columns.shape[1] - 1
    return structural_null(after, evidence, columns, seed), float(alone(after, after.memory).base_score()[0])


def _sizes(before: Fitted, after: Fitted, c: Candidate) -> list[int]:
    """Numbers of the unknowns that the candidate added, its shape aside."""
    if c.part is None or c.mechanism == "coarse_network":
        return []
    known = {u.name for u in before.problem.unknowns}
    new = [k for k, u in enumerate(after.problem.unknowns) if u.name not in known]
    return [k for k in new if after.problem.unknowns[k].name.rpartition(".")[2] not in c.shape]


def _as_column(evidence: Evidence, after: Fitted, own: list[int]) -> Evidence:
    """The largest of these unknowns as one column more, per unit of its value; all of them no parameters any more."""
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
    bound = FAR * max(abs(value[most]), TINY)
    low = -bound if unknowns[most].scale == "linear" else 0.0
    return replace(evidence, batches=batches, low=np.append(evidence.low, low), high=np.append(evidence.high, bound))


MOST = 64  # nulls in a folder; the oldest go


def cached_null(
    folder: Path | None,
    fitted: Fitted,
    evidence: Evidence,
    counts: Mapping[str, int],
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Null:
    """`structural_null` as it was worked out before, if `folder` has it, else worked out and kept there.

    What cannot be read counts as not there; a folder that cannot be written keeps nothing.
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
    try:
        yield version("thermodrift")
    except PackageNotFoundError:  # run from its sources alone
        yield ""
    yield np.__version__
    yield f"{seed} {TWINS} {SCALES}"
    yield fitted.machine.machine
    yield fitted.part.model_dump_json()
    yield from (f"{name} {column}" for name, column in counts.items())


def _numbers(fitted: Fitted, evidence: Evidence) -> Iterator[np.ndarray]:
    """All that a null is made of; of the evidence's rows their sums, which tell as much."""
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
        for old in kept[MOST:]:
            old.unlink(missing_ok=True)
    except OSError:  # it is worked out again next time
        return
