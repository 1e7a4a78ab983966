"""Cases on real recordings: known effects grafted on them (plant C), or known physics withheld from the file (D)."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from data.errors import InputError
from twin.plants.seeds import stream
from twin.proof.spec import CaseSpec, PlantKind
from twin.proof.suite.built import Built
from twin.proof.suite.secret import Which, digits, number

REAL: tuple[PlantKind, ...] = ("grafted", "withheld")


def real_suite(
    seed: bytes | int, data: Path, which: Which, plants: Sequence[PlantKind] = REAL, first: int = 1
) -> list[CaseSpec]:
    """Every case whose recordings lie in the folder `data`, in an order drawn by lot, named from number `first` on.

    A grafted case and its reference, the same runs without the graft, have one seed; the case names its reference.

    Raises:
        InputError: a kind of plant that has no real recordings.
    """
    for plant in plants:
        if plant not in REAL:
            raise InputError(f"suite: plants: got {plant!r}, expected {' or '.join(REAL)}; name those")
    known = [(plant, name, _cases(plant).CASES[name]) for plant in plants for name in _cases(plant).cases(data)]
    order = stream(number(seed, which, "real order"), "order").permutation(len(known))
    wide = digits(first + len(known))
    told = {known[int(n)][:2]: f"case_{first + k:0{wide}d}" for k, n in enumerate(order)}
    out = []
    for n in order:
        plant, name, case = known[int(n)]
        options = {"case": name}
        if getattr(case, "reference", name) != name:
            options["reference"] = told[plant, case.reference]
        own = number(seed, which, f"{plant} {case.machine}")
        out.append(CaseSpec(told[plant, name], case.kind, plant, own, options=options, suite=which))
    return out


def build_real(spec: CaseSpec, data: Path) -> Built:
    """A case on the real recordings in the folder `data`.

    Raises:
        InputError: an unknown case, or no recordings there.
    """
    case = _cases(spec.plant).build(spec.options["case"], data, spec.seed)
    answer: dict[str, Any] = {
        **case.answer, "case": spec.name, "suite": spec.suite, "reference": spec.options.get("reference"),
        "options": dict(spec.options), "redraw": spec.plain(),
    }  # fmt: skip
    return Built(case.machine, case.recordings(), answer)


def _cases(plant: str) -> Any:
    return import_module(f"twin.plants.{plant}.cases")
