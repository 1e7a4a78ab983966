"""What to train, and whether that is possible; apart from `pipelines.jobs.training`, whose imports take seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from data.errors import InputError, check_suffix, closest
from data.machine import Machine, load_machine
from models.protocols import PROTOCOLS
from models.selection.crossing import Plan
from pipelines.settings import Settings

REPORT_SUFFIXES = (".html", ".md")


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
    workers: int = 0  # processes of the grid; 0: as many as make it faster


def check_request(request: TrainRequest, settings: Settings) -> tuple[Machine, tuple[str, ...]]:
    """The machine and the error channels to learn.

    Raises:
        InputError: a machine file that cannot be used, an unknown channel, recordings that do not exist, a report of
            an unknown kind, a family that the machine cannot have, or a promotion rule that the chosen protocols do
            not serve.
    """
    machine = load_machine(request.machine_file)
    targets = error_channels(request.targets, machine)
    missing = [str(p) for p in request.recordings if not p.exists()]
    if missing:
        raise InputError(f"recordings {', '.join(missing)}: no such file or folder; give existing ones")
    if request.report is not None:
        check_suffix("report", request.report, REPORT_SUFFIXES)
    rule = settings.promotion
    protocols = request.plan.protocols or tuple(PROTOCOLS)
    if request.promote and not rule.offered(protocols):
        raise InputError(
            f"protocols: got {', '.join(protocols)}, but promotion judges by {', '.join(rule.protocols)}; "
            "add one of them, or train without promotion (--no-promote)"
        )
    if request.plan.families:
        request.plan.suited(machine, [machine.channel(t) for t in targets])
    return machine, targets


def error_channels(wanted: Sequence[str], machine: Machine) -> tuple[str, ...]:
    """The error channels that are wanted, or all.

    Raises:
        InputError: a machine without one, or an unknown channel.
    """
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


def request_for(
    machine_file: str,
    recordings: Sequence[str],
    effort: str,
    channels: Sequence[str],
    families: Sequence[str],
    selectors: Sequence[str],
) -> TrainRequest:
    """A scheduled retraining: of what arrived, and only if that is new."""
    plan = Plan(tuple(selectors), tuple(families), effort=effort)  # type: ignore[arg-type]
    return TrainRequest(Path(machine_file), tuple(Path(r) for r in recordings), tuple(channels), plan, only_if_new=True)
