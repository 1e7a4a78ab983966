"""What to train, judged before anything is started."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from data.errors import InputError, closest
from data.machine import Machine, load_machine
from models.crossing import Plan
from pipelines.settings import Settings

REPORT_ENDINGS = (".html", ".md")


@dataclass(frozen=True)
class TrainRequest:
    """What to train. `recordings` empty: what the lake holds. `targets` empty: every error channel."""

    machine_file: Path
    recordings: tuple[Path, ...] = ()
    targets: tuple[str, ...] = ()
    plan: Plan = field(default_factory=Plan)
    report: Path | None = None
    promote: bool = True
    only_if_new: bool = False  # stop where the last training saw the same batches
    workers: int = 0  # processes of the grid; 0: as many as pay


def check_request(request: TrainRequest, settings: Settings) -> tuple[Machine, tuple[str, ...]]:
    """The machine and the error channels to learn.

    Raises:
        InputError: a machine file that cannot be used, an unknown channel, recordings that do not exist, a report of
            an unknown kind, a family that the machine cannot have, or a promotion rule that the chosen protocols do
            not serve.
    """
    machine = load_machine(request.machine_file)
    targets = _targets(request.targets, machine)
    missing = [str(p) for p in request.recordings if not p.exists()]
    if missing:
        raise InputError(f"recordings {', '.join(missing)}: no such file or folder; give existing ones")
    if request.report is not None:
        check_ending("report", request.report, REPORT_ENDINGS)
    rule = settings.promotion.protocol
    if request.promote and rule not in request.plan.protocols:
        raise InputError(
            f"protocols: got {', '.join(request.plan.protocols)}, but promotion judges by {rule}; add it, or train "
            "without promotion (--no-promote)"
        )
    if request.plan.families:
        request.plan.suited(machine, [machine.channel(t) for t in targets])
    return machine, targets


def check_ending(what: str, path: Path, allowed: Sequence[str]) -> None:
    """Raises InputError where a file's ending is none of `allowed`."""
    if path.suffix not in allowed:
        raise InputError(f"{what} {path}: got the ending {path.suffix!r}, expected {' or '.join(allowed)}")


def _targets(wanted: Sequence[str], machine: Machine) -> tuple[str, ...]:
    allowed = machine.names("error")
    if not allowed:
        raise InputError(
            f"machine {machine.machine}: no channel has role: error, so there is nothing to learn; give the "
            "displacement that role in the machine file"
        )
    for t in wanted:
        if t not in allowed:
            raise InputError(f"machine {machine.machine}: no error channel {t!r}; {closest(t, allowed)}")
    return tuple(dict.fromkeys(wanted)) or allowed
