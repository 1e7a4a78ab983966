"""The cases of a proof: simulated plants from the suite, and real recordings where a folder holds them."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, get_args

from data.errors import InputError
from twin.proof.sealing.seal import Spec, Suite
from twin.proof.spec import CaseSpec, PlantKind

Which = Literal["development", "sealed"]
SUITES: tuple[Which, ...] = get_args(Which)
REAL: tuple[PlantKind, ...] = ("grafted", "withheld")  # their cases are those that the recordings give, each once
SECRET_BYTES = 32
SEED_BITS = 63  # of a development suite that nobody gave a seed


@dataclass(frozen=True)
class ProofRequest:
    """What to prove: `cases` of simulated plants, and every case that real recordings in `data` give.

    `seed` None: a secret for a sealed suite, a drawn and told number for a development one.
    """

    out: Path
    cases: int = 60
    suite: Which = "sealed"
    plants: tuple[PlantKind, ...] = ("elements", "volumes")
    seed: int | None = None
    data: Path | None = None


@dataclass(frozen=True)
class RealSpec:
    """A case of real recordings, by the name that its plant has for it."""

    name: str
    plant: PlantKind
    real: str
    data: Path
    seed: int
    suite: Which


def drawn(request: ProofRequest) -> Suite:
    """The specs of a request and what they were drawn from.

    Raises:
        InputError: a seed for a sealed suite; real recordings asked for and none there.
    """
    if request.suite == "sealed" and request.seed is not None:
        raise InputError(
            f"--seed: got {request.seed}; a sealed suite is drawn from a secret, leave it out or give "
            "--suite development"
        )
    number = secrets.randbits(SEED_BITS) if request.seed is None else request.seed
    root = secrets.token_bytes(SECRET_BYTES) if request.suite == "sealed" else str(number).encode()
    secret = request.suite == "sealed"
    specs: list[Spec] = [*_simulated(request, root if secret else number), *_real(request, root)]
    return Suite(request.suite, specs, root.hex() if secret else str(number), secret)


def number_of(request: ProofRequest) -> int:
    """How many cases a request has."""
    return (request.cases if _plants(request) else 0) + len(_names(request))


def make_case(spec: CaseSpec | RealSpec, folder: Path) -> dict[str, Any]:
    """Build a case into a folder; gives its answer."""
    from twin.proof.suite import Built, build, write_built

    if isinstance(spec, CaseSpec):
        built = build(spec)
    else:
        case = _plant(spec.plant).build(spec.real, spec.data, spec.seed)
        key = case.answer | {"case": spec.name, "suite": spec.suite}
        built = Built(case.machine, case.recordings(), key)
    write_built(built, folder)
    return built.answer


def _plants(request: ProofRequest) -> list[PlantKind]:
    return [p for p in request.plants if p not in REAL]


def _simulated(request: ProofRequest, seed: bytes | int) -> Sequence[CaseSpec]:
    from twin.proof.suite import suite

    plants = _plants(request)
    return suite(seed, request.cases, request.suite, plants) if plants else ()


def _real(request: ProofRequest, root: bytes) -> list[RealSpec]:
    """In an order that only the root gives, after the simulated ones."""
    first = request.cases if _plants(request) else 0
    lots = {(plant, name): _lot(root, plant, name) for plant, name in _names(request)}
    return [
        RealSpec(f"case_{first + k:04d}", plant, name, Path(str(request.data)).resolve(), lot, request.suite)
        for k, ((plant, name), lot) in enumerate(sorted(lots.items(), key=lambda item: item[1]), 1)
    ]


def _names(request: ProofRequest) -> list[tuple[PlantKind, str]]:
    wanted = [p for p in request.plants if p in REAL]
    if wanted and request.data is None:
        raise InputError(f"--plants {wanted[0]}: is made of real recordings; give their folder by --data")
    found = [(p, n) for p in wanted for n in _plant(p).cases(request.data)]
    if wanted and not found:
        raise InputError(f"--data {request.data}: holds no recordings of {' or '.join(wanted)}; give another folder")
    return found


def _lot(root: bytes, plant: str, name: str) -> int:
    told = b"\0".join([b"thermodrift proof, real", plant.encode(), name.encode(), root])
    return int.from_bytes(hashlib.sha256(told).digest(), "big")


def _plant(kind: PlantKind) -> Any:
    return import_module(f"twin.plants.{kind}.cases")
