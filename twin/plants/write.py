"""A case on disk as a user would have it: a machine file and CSV recordings; the answer key stands elsewhere."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import yaml

from data.atomic_file import write_atomic
from data.errors import InputError
from data.machine import Machine
from twin.plants.plant import Case


def write_case(case: Case, folder: Path, key_folder: Path | None = None) -> tuple[Path, Path, Path]:
    """Writes `machine.yml` and `recordings/*.csv` below `folder`, `truth.json` into `key_folder`.

    Returns the machine file, the recordings' folder and the key. `key_folder` is by default beside `folder`, with
    `_key` added to its name; it must not lie inside, where whoever is asked could find it.

    Raises:
        InputError: the key would lie in the case's folder, or a folder cannot be written.
    """
    key_folder = folder.with_name(f"{folder.name}_key") if key_folder is None else key_folder
    if key_folder.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"plant: the key's folder {key_folder} lies in {folder}; give one outside")
    recordings = folder / "recordings"
    machine, key = folder / "machine.yml", key_folder / "truth.json"
    try:
        recordings.mkdir(parents=True, exist_ok=True)
        key_folder.mkdir(parents=True, exist_ok=True)
        write_atomic(machine, machine_text(case.machine))
        for name, text in recording_texts(case).items():
            write_atomic(recordings / name, text)
        write_atomic(key, json.dumps(case.truth, indent=1) + "\n")
    except OSError as error:
        raise InputError(f"plant: {folder} cannot be written ({error}); give a folder that can be") from None
    return machine, recordings, key


def machine_text(machine: Machine) -> str:
    """The machine as a machine file's text; reads back as the same."""
    plain = machine.model_dump(mode="json", exclude_defaults=True)
    return f"# {machine.description or machine.machine}\n" + yaml.safe_dump(plain, sort_keys=False, width=120)


def recording_texts(case: Case) -> dict[str, str]:
    """File name -> CSV text of every run, as the recorder wrote it."""
    return {f"{batch}.csv": csv_text(case.machine.machine, table) for batch, table in case.tables.items()}


def csv_text(machine: str, table: pd.DataFrame) -> str:
    """A recording with a first line that calls it simulated; a lost sample is an empty cell."""
    head = f"# simulated recording, machine {machine}\n"
    return head + str(table.to_csv(index=False, float_format="%.10g", lineterminator="\n"))
