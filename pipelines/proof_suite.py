"""The cases of a proof: simulated plants from the suite, and real recordings where a folder holds them."""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from data.errors import InputError
from twin.proof.sealing.seal import Suite
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
    secret = request.suite == "sealed"
    seed = secrets.token_bytes(SECRET_BYTES) if secret else number
    specs = specs_of(request, seed)
    return Suite(request.suite, specs, seed.hex() if isinstance(seed, bytes) else str(seed), secret)


def specs_of(request: ProofRequest, seed: bytes | int) -> list[CaseSpec]:
    """Cases of simulated plants first, then every case that the real recordings give.

    Raises:
        InputError: real recordings asked for and none there.
    """
    from twin.proof.suite import real_suite, suite

    plants = [p for p in request.plants if p not in REAL]
    real = [p for p in request.plants if p in REAL]
    specs = suite(seed, request.cases, request.suite, plants) if plants else []
    if not real:
        return specs
    if request.data is None:
        raise InputError(f"--plants {real[0]}: is made of real recordings; give their folder by --data")
    more = real_suite(seed, request.data, request.suite, real, first=len(specs) + 1)
    if not more:
        raise InputError(f"--data {request.data}: holds no recordings of {' or '.join(real)}; give another folder")
    return [*specs, *more]


def make_case(spec: CaseSpec, folder: Path, data: Path | None = None) -> dict[str, Any]:
    """Build a case into a folder; gives its answer."""
    from twin.proof.suite import build, write_built

    built = build(spec, data)
    write_built(built, folder)
    return built.answer
