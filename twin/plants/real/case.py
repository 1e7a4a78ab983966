"""A case of real recordings: what a diagnosis sees, and the answer key beside it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch
from data.machine import Machine

SCHEMA = "thermodrift.proof_answer/1"
Place = tuple[str, str]  # kind and name
Window = list[Any]  # batch, start s, end s


@dataclass(frozen=True)
class RealCase:
    """Machine file and batches are all that a diagnosis sees; `answer` is plain data."""

    machine: Machine
    batches: list[Batch]
    answer: dict[str, Any]

    def recordings(self) -> dict[str, str]:
        """File name -> CSV text of every run: a first line that says what it is, a lost sample an empty cell."""
        head = "# real recording, simulated response\n" if self.machine.simulated else "# real recording\n"
        return {
            f"{b.batch_id}.csv": head + str(b.table.to_csv(index=False, float_format="%.10g", lineterminator="\n"))
            for b in self.batches
        }


def term(
    effect: str, mechanism: str | None, where: Place, *, parameters: Mapping[str, tuple[float, str]] | None = None,
    also: Iterable[Place] = (), neighbours: Iterable[str] = (), words: str = "", size: float = 1.0,
    active: str | list[Window] = "always", driver: str | None = None, same_as: Iterable[tuple[str, Place]] = (),
) -> dict[str, Any]:  # fmt: skip
    """One true term of an answer key."""
    return {
        "effect": effect, "mechanism": mechanism, "where": _place(where), "also": [_place(p) for p in also],
        "neighbours": list(neighbours),
        "parameters": {k: {"value": float(v), "unit": u} for k, (v, u) in (parameters or {}).items()},
        "words": words, "size": float(size), "limit_share": None, "decoy": False, "active": active, "driver": driver,
        "same_as": [{"mechanism": m, "where": _place(p)} for m, p in same_as],
    }  # fmt: skip


def answer(
    name: str, plant: str, kind: str, machine: Machine, seed: int, terms: list[dict[str, Any]], words: str,
    **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """The answer key. Case and suite are for the caller to set; `more` is what this kind of plant adds."""
    return {
        "schema": SCHEMA, "case": name, "kind": kind, "plant": plant, "suite": "development",
        "simulated": machine.simulated, "words": words, "machine": machine.machine, "seed": seed, "terms": terms,
        "idle_channels": [], "options": {}, "redraw": {"plant": plant, "name": name, "seed": seed}, **more,
    }  # fmt: skip


def windows(batches: Sequence[Batch], active: Sequence[NDArray[np.bool_]]) -> list[Window]:
    """Stretches of rows that are active, one mask (rows,) a batch; each ends where the next row begins."""
    out: list[Window] = []
    for batch, mask in zip(batches, active, strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
        time_s = np.append(batch.time_s, batch.time_s[-1])
        stretches = time_s[edges.reshape(-1, 2)]
        out += [[batch.batch_id, float(a), float(b)] for a, b in stretches if b > a]
    return out


def linked(twin: Mapping[str, Any], body: str) -> list[str]:
    """Bodies of a machine file's twin part that a link joins with this one."""
    ends = [key.split("-") for key in twin.get("links", {})]
    return sorted({b if a == body else a for a, b in ends if body in (a, b)})


def _place(place: Place) -> dict[str, str]:
    kind, name = place
    return {"kind": kind, "name": name}
