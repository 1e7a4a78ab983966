"""The fleet file: defaults, paths, dates, and a line for every mistake."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from data.errors import InputError
from pipelines.fleet.fleet_file import AlertRules, Fleet, FleetMachine, When, load_fleet, of_one

GOOD = """
at_once: 2
timezone: Europe/Berlin
alerts: {webhook: "https://alerts.example/x", outside_runs: 2}
defaults: {effort: quick, families: [zero, ridge], when: {cron: "0 5 * * 1"}}
machines:
- {machine: mill.yml, recordings: [incoming/mill, /data/mill]}
- {machine: lathe.yml, recordings: [incoming/lathe], when: {every_h: 6}, families: [], channels: [z]}
- {machine: gantry.yml, recordings: [incoming/gantry], when: {watch: true}, effort: usual}
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "fleet.yml"
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_hold_unless_a_machine_has_its_own(tmp_path: Path) -> None:
    fleet = load_fleet(written(tmp_path, GOOD), "UTC")
    mill, lathe, gantry = fleet.machines
    assert (fleet.at_once, fleet.timezone, fleet.alerts.webhook) == (2, "Europe/Berlin", "https://alerts.example/x")
    assert fleet.alerts == AlertRules(webhook="https://alerts.example/x", outside_runs=2)
    assert mill.file == str(tmp_path / "mill.yml")
    assert mill.recordings == (str(tmp_path / "incoming/mill"), "/data/mill")
    assert (mill.effort, mill.families, mill.channels, mill.when.cron) == ("quick", ("zero", "ridge"), (), "0 5 * * 1")
    assert (lathe.families, lathe.channels, lathe.when.every_h) == ((), ("z",), 6)
    assert (gantry.effort, gantry.when.watch, gantry.when.cron) == ("usual", True, None)
    assert Fleet.from_json(fleet.as_json()) == fleet


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "key 'machines' is missing"),
        ("machines: []", "key 'machines': got []"),
        ("machines: [{machine: m.yml}]", "key 'machines.0.recordings' is missing"),
        ("machines: [{machine: m.yml, recordings: [a], efort: quick}]",
         "unknown key 'machines.0.efort'; did you mean 'effort'?"),
        ("machines: [{machine: m.yml, recordings: [a], effort: fast}]", "key 'machines.0.effort': got 'fast'; unknown"),
        ("machines: [{machine: m.yml, recordings: [a], families: [rigde]}]", "did you mean 'ridge'?"),
        ("defaults: {selectors: [nome]}\nmachines: [{machine: m.yml, recordings: [a]}]", "key 'defaults.selectors'"),
        ("machines: [{machine: m.yml, recordings: [a], when: {cron: monday}}]",
         "key 'machines.0.when.cron': got 'monday'; expected five fields"),
        ("machines: [{machine: m.yml, recordings: [a], when: {cron: 0 0 30 2 *}}]", "key 'machines.0.when.cron'"),
        ("machines: [{machine: m.yml, recordings: [a], when: {every_h: 0}}]", "key 'machines.0.when.every_h': got 0"),
        ("machines: [{machine: m.yml, recordings: [a], when: {watch: true, every_h: 1}}]",
         "expected one of cron, every_h and watch, got every_h and watch"),
        ("machines: [{machine: m.yml, recordings: [a], when: {every_h: 1, quiet_min: 1}}]",
         "quiet_min goes with watch"),
        ("machines: [{machine: m.yml, recordings: [a]}, {machine: ./m.yml, recordings: [b]}]",
         "key 'machines.1.machine': "),
        ("timezone: Europe/Berln\nmachines: [{machine: m.yml, recordings: [a]}]", "did you mean 'Europe/Berlin'?"),
        ("alerts: {webhook: alerts.example}\nmachines: [{machine: m.yml, recordings: [a]}]",
         "key 'alerts.webhook': got 'alerts.example'; expected an address such as"),
        ("alerts: {outside_runs: 6}\nmachines: [{machine: m.yml, recordings: [a]}]", "is more than of_runs 5"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_with_its_key(tmp_path: Path, text: str, said: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError) as error:
        load_fleet(path, "UTC")
    (line,) = str(error.value).splitlines()
    assert line.startswith(f"fleet file {path}") and said in line


def test_every_mistake_has_its_line(tmp_path: Path) -> None:
    text = "at_once: 0\nmachines:\n- {machine: m.yml, recordings: [a], effort: fast}\n- {machine: n.yml}\n"
    with pytest.raises(InputError) as error:
        load_fleet(written(tmp_path, text), "UTC")
    lines = str(error.value).splitlines()
    assert len(lines) == 3 and [next(n for n in (1, 3, 4) if f" line {n}:" in said) for said in lines] == [1, 3, 4]


def test_dates_are_in_the_zone_of_the_fleet(tmp_path: Path) -> None:
    fleet = load_fleet(written(tmp_path, GOOD), "UTC")
    sunday = datetime(2026, 11, 29, 12, 0, tzinfo=UTC)
    mill, lathe, gantry = (m.when.next(sunday, fleet.zone) for m in fleet.machines)
    assert mill == datetime(2026, 11, 30, 4, 0, tzinfo=UTC) and mill.utcoffset() == timedelta(hours=1)
    assert lathe == sunday + timedelta(hours=6) and gantry is None


def test_options_make_a_fleet_of_one(tmp_path: Path) -> None:
    fleet = of_one(tmp_path / "mill.yml", [tmp_path], "0 5 * * 1", "UTC")
    assert fleet.machines == (
        FleetMachine("mill", str(tmp_path / "mill.yml"), (str(tmp_path),), When(cron="0 5 * * 1")),
    )
    assert fleet.at(0) == "" and Fleet.from_json(fleet.as_json()) == fleet
    with pytest.raises(InputError, match=r"--cron: got 'monday', expected five fields \(minute hour day month weekday"):
        of_one(tmp_path / "mill.yml", [tmp_path], "monday", "UTC")
