"""What the files of an export state and what it refuses, for every registered export."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from compensation.exports import EXPORTS
from compensation.exports.base import Export, Exporter
from data.errors import InputError
from tests.toys.exported import DIGEST, export_of, lagged, offset_only, straight

FORMS = {
    "an offset": export_of(offset_only()),
    "an offset and a slope": export_of(straight()),
    "a lag": export_of(lagged()),
    "two axes": export_of(offset_only(), lagged()),
    "odd names": export_of(replace(offset_only(), axis="µ 1/a"), machine="Fräse */ 1"),
}
STATED = ("mill 1", "champion@production", "v7", DIGEST, "2026-01-02T03:04:05Z", "degC", "um", "-error_um", "hold")


@pytest.fixture(params=EXPORTS, name="c")
def exporter(request: pytest.FixtureRequest) -> Exporter:
    exporter: Exporter = EXPORTS[request.param]()
    return exporter


def written(c: Exporter, export: Export, folder: Path) -> dict[str, bytes]:
    """Content of the files by name; what stood in `folder` before is there as well."""
    c.write(export, folder)
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_every_file_states_what_it_is(c: Exporter, tmp_path: Path) -> None:
    """A file at a control for years says which model it is and what it assumes, or a file of its name does."""
    files = written(c, export_of(offset_only()), tmp_path)
    assert files and all(name.startswith("mill_1") for name in files)
    for name in files:
        of_name = b"".join(content for n, content in files.items() if Path(n).stem == Path(name).stem)
        assert not [s for s in STATED if s not in of_name.decode(errors="replace")], name


def test_simulated_models_are_marked_and_earlier_files_replaced(c: Exporter, tmp_path: Path) -> None:
    for simulated in (True, False):
        files = written(c, export_of(offset_only(), simulated=simulated), tmp_path)
        marked = {name for name, content in files.items() if re.search(rb"(?<!_)SIMULATED", content)}
        sources = {name for name in files if name.endswith(".c")}  # whose header states it
        assert marked | sources == set(files) if simulated else not marked


def test_the_same_bytes_every_time(c: Exporter, tmp_path: Path) -> None:
    (tmp_path / "1").mkdir(), (tmp_path / "2").mkdir()
    one, other = (written(c, export_of(offset_only()), tmp_path / name) for name in "12")
    assert one == other


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_written_or_refused_in_one_line(c: Exporter, form: str, tmp_path: Path) -> None:
    try:
        paths = c.write(FORMS[form], tmp_path)
    except InputError as error:
        assert "\n" not in str(error) and "these exports can: " in str(error) and not list(tmp_path.iterdir())
    else:
        assert paths and all(p.parent == tmp_path and p.stat().st_size and p.name.isascii() for p in paths)
