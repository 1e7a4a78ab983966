"""Run plans through the twin as a user meets it: recordings, reports, screen, and one line where something is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from data.batch import Batch
from data.describe import drafted
from data.errors import InputError
from data.lake import Lake
from data.machine import load_machine
from data.recording import read_batches
from pipelines import cli
from pipelines.commands.simulate import (
    Simulated,
    SimulationRequest,
    beginning,
    error_table,
    heat_table,
    hottest,
    jobs_of,
    simulate_job,
    simulate_plans,
)
from plants.sample import sample_machine
from tests.toys.command import Call, in_process
from tests.twin.machines import TWO_BODIES

ROOT = Path(cli.__file__).resolve().parents[1]
SAMPLE = ROOT / "machines" / "sample_vmc.yml"
PLANS = ROOT / "docs" / "plans"
HOUR = 360  # steps of 10 s


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Call:
    """`thermodrift ARGS` in this process, in an empty folder, with a lake of its own."""
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    return in_process(monkeypatch, capsys)


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Two bodies in a room, and a plan of 20 minutes beside it."""
    (tmp_path / "plan.yml").write_text(
        "name: short run\nstages: [{minutes: 5, rpm: 0}, {minutes: 15, rpm: 3000}]\nsurroundings: {room: 21 degC}\n"
    )
    path = tmp_path / "two.yml"
    path.write_text(yaml.safe_dump(TWO_BODIES, sort_keys=False))
    return path


@pytest.fixture
def plain_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages and pictures, which take seconds to draw, as empty files."""

    def iso(_: Batch, folder: Path) -> Path:
        folder.mkdir(exist_ok=True)
        return folder / "report.html"

    monkeypatch.setattr("reports.twin.iso230_3.write_iso_report", iso)
    monkeypatch.setattr("reports.twin.figures.overview_png", lambda _: b"")
    monkeypatch.setattr("reports.twin.page.write_twin_report", lambda path, *_: path.write_bytes(b""))


def simulated(machine: Path, plan: Path, out: Path, **options: object) -> Batch:
    return one_plan(machine, plan, out, **options).batch


def one_plan(machine: Path, plan: Path, out: Path, **options: object) -> Simulated:
    """A plan simulated, nothing written."""
    request = SimulationRequest(machine, (plan,), out, **options)  # type: ignore[arg-type]
    read = load_machine(machine)
    network, (job,) = jobs_of(request, read)
    return simulate_job(job, network, read, request)


def written(machine: Path, plan: Path, out: Path, **options: object) -> Batch:
    request = SimulationRequest(machine, (plan,), out, **options)  # type: ignore[arg-type]
    return simulate_plans(request, lambda _: None, lambda *_: None).plans[0].batch


def warm_up(folder: Path, rpm: float, room: str) -> Path:
    path = folder / f"run_{rpm:g}.yml"
    path.write_text(f"stages: [{{hours: 6, spindle_rpm: {rpm}}}]\nsurroundings: {{room: {room}}}\n")
    return path


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[float, Batch]:
    """The sample machine's warm-ups: 20 °C start everywhere, room +2.3 K in 6 h."""
    folder = tmp_path_factory.mktemp("runs")
    plans = tuple(warm_up(folder, rpm, f"{{start: 20 degC, drift: {2.3 / 6} K/h}}") for rpm in (2000, 4000, 6000))
    request = SimulationRequest(SAMPLE, plans, folder / "out")
    machine = load_machine(SAMPLE)
    network, jobs = jobs_of(request, machine)
    batches = [simulate_job(job, network, machine, request).batch for job in jobs]
    return dict(zip((2000.0, 4000.0, 6000.0), batches, strict=True))


def test_warm_ups_reach_the_figures_of_the_class(runs: dict[float, Batch]) -> None:
    figures_um = {2000: (22, 25, 25), 4000: (52, 54, 52), 6000: (82, 83, 77)}
    for (rpm, batch), front_K in zip(runs.items(), (6.9, 14.0, 21.1), strict=True):
        z_um = batch.values("z")[[HOUR, 2 * HOUR, 6 * HOUR]]
        np.testing.assert_allclose(z_um, figures_um[int(rpm)], rtol=0.06)
        body_K = (batch.values("front")[-1] - batch.values("room")[-1]) / 0.95 + batch.values("room")[-1] - 20.0
        assert body_K == pytest.approx(front_K, rel=0.03)


def test_a_room_step_on_the_idle_machine(tmp_path: Path) -> None:
    plan = warm_up(tmp_path, 0, "[[0, 20 degC], [0.001, 25], [6, 25]]")
    machine = yaml.safe_load(SAMPLE.read_text())
    machine["twin"]["mechanisms"]["auxiliaries"]["parameters"]["heat"]["value"] = "1e-9 W"
    idle = tmp_path / "idle.yml"
    idle.write_text(yaml.safe_dump(machine, sort_keys=False))
    z_um = simulated(idle, plan, tmp_path / "out").values("z")
    assert z_um.max() == pytest.approx(6.0, abs=1.0)
    assert z_um.argmax() / HOUR == pytest.approx(1.8, abs=0.3)


def test_the_twin_and_the_sample_machine_agree(tmp_path: Path) -> None:
    plan = tmp_path / "run.yml"
    plan.write_text(
        "stages: [{minutes: 5}, {hours: 2, spindle_rpm: 6000}, {hours: 1, spindle_rpm: 3000}, {hours: 1, "
        "spindle_rpm: 0}]\nsurroundings: {room: {start: 18 degC, drift: 0.5 K/h, ripple: 0.3 K, period: 20 min}}\n"
    )
    one = one_plan(SAMPLE, plan, tmp_path / "out")
    cells, given = one.simulation.cells_degC, one.job.plan
    assert cells is not None
    # the sample machine holds its heat for a step: 2-s steps make that error small
    fine = 5
    room = np.repeat(given.surroundings["room"][:-1], fine) + np.tile(np.arange(fine) / fine, len(given.time_s) - 1) * (
        np.repeat(np.diff(given.surroundings["room"]), fine)
    )
    room = room + np.diff(room, append=given.surroundings["room"][-1]) / 2
    nodes = sample_machine.simulate(
        np.repeat(given.drivers["spindle_rpm"], fine)[:, None], room[:, None],
        np.array([17.65 + 0.5 * (18.0 - 17.65)]), np.full((1, 14), 18.0), np.ones(1), 10.0 / fine,
    )[::fine, 0]  # fmt: skip
    order = [sample_machine.NODE[c] for c in one.simulation.network.cells]
    np.testing.assert_allclose(cells[0, 0], nodes[:, order], atol=0.02)
    speed = np.r_[given.drivers["spindle_rpm"], given.drivers["spindle_rpm"][-1:]]  # from each row on
    error_um = sample_machine.displacement_um(nodes - nodes[0], speed)
    for channel in "xyz":
        np.testing.assert_allclose(one.batch.values(channel), error_um[channel], atol=0.06)


def test_the_files_of_a_fresh_user(call: Call, tmp_path: Path) -> None:
    done = call("simulate", *sorted(PLANS.glob("*.yml")), "--machine", SAMPLE, "--out", "out")
    assert done.code == 0, done.err
    assert "iso_spindle_test: Rotating-spindle test at 4000 rpm, 5:05 h, simulated; converged to" in done.out
    assert "hottest body: shaft, 35.8 °C at 4:05 h" in done.out
    assert "front_bearings" in done.out and "overview  out/overview.png" in done.out
    out = tmp_path / "out"
    assert sorted(p.name for p in out.iterdir()) == [
        "iso_spindle_test", "iso_spindle_test.parquet", "overview.png", "spectrum_day", "spectrum_day.parquet",
        "twin.html",
    ]  # fmt: skip
    assert "SIMULATED" in (out / "spectrum_day" / "report.html").read_text(encoding="utf-8").upper()
    page = (out / "twin.html").read_text(encoding="utf-8")
    assert "spectrum_day: where the watts go" in page and "Shapes of the slowest modes" in page
    assert "Rotating-spindle test" in (out / "iso_spindle_test" / "report.md").read_text(encoding="utf-8")
    plain = pd.read_parquet(out / "iso_spindle_test.parquet")
    machine = load_machine(SAMPLE)
    assert list(plain.columns) == ["time_s", *machine.channels, "batch", "simulated"]
    assert plain["simulated"].all() and plain["time_s"].diff().dropna().eq(10.0).all()

    (back,) = read_batches(out / "iso_spindle_test.parquet", machine)
    assert back.simulated and back.step_s == machine.recording.step_s and back.start is None
    assert back.labels["plan"] == "Rotating-spindle test at 4000 rpm" and back.labels["thermodrift"]
    np.testing.assert_allclose(back.values("bed")[10], plain["bed"][285:316].mean(), atol=1e-3)
    draft = drafted([out / "iso_spindle_test.parquet"])[0]
    assert "role: driver" in draft and "time: {column: time_s, unit: s}" in draft

    done = call("ingest", out / "iso_spindle_test.parquet", "--machine", SAMPLE)
    assert done.code == 0 and "batches new: 1" in done.out
    assert Lake(tmp_path / "home" / "lake").load("sample_vmc", "iso_spindle_test").simulated

    done = call("report", "--iso", "--machine", SAMPLE, "iso_spindle_test", "--out", "tests")
    assert done.code == 0 and done.out.strip() == "tests/iso_spindle_test/report.html"


@pytest.mark.usefixtures("plain_pages")
def test_a_simulation_of_a_real_machine_stays_simulated_in_the_lake(call: Call, small: Path, tmp_path: Path) -> None:
    """The file says so, whatever the machine file claims of recordings, and however its columns are called."""
    raw = {**TWO_BODIES, "simulated": False}
    raw["recording"] = {"step_s": 60, "time": {"column": "Zeit", "unit": "timestamp"}}
    raw["channels"] = {
        **raw["channels"],
        "room": {**raw["channels"]["room"], "column": "T [°F]", "unit_in_file": "degF"},
    }
    small.write_text(yaml.safe_dump(raw, sort_keys=False))
    batch = written(small, tmp_path / "plan.yml", tmp_path / "out", begins=beginning("2025-07-15 06:30"))
    assert call("ingest", "out/plan.parquet", "--machine", small).code == 0
    held = Lake(tmp_path / "home" / "lake").load("two_bodies", "plan")
    assert held.simulated and held.start == pd.Timestamp("2025-07-15 06:30")
    np.testing.assert_allclose(held.values("room"), 21.0)
    assert held.values("z")[-1] == pytest.approx(batch.values("z")[-3:].mean(), abs=0.05)
    small.write_text(small.read_text().replace("machine: two_bodies", "machine: another"))
    with pytest.raises(InputError, match=r"plan.parquet: written for machine 'two_bodies', .* of 'another'; take"):
        list(read_batches(tmp_path / "out" / "plan.parquet", load_machine(small)))


def test_tables_say_what_the_numbers_are(small: Path, tmp_path: Path) -> None:
    one = one_plan(small, tmp_path / "plan.yml", tmp_path / "out")
    z = one.batch.values("z")
    (row,) = error_table(one.batch).to_dict("records")
    assert (row["channel"], row["unit"]) == ("z", "um") and row["end"] == z[-1] and row["range"] == np.ptp(z)
    assert np.isnan(row["at_1h"])  # the plan lasts 20 minutes
    body, degC, time_s = hottest(one)
    assert body == "shaft" and degC > one.batch.values("t_head").max() and time_s == 1200.0
    (heat,) = heat_table(one).to_dict("records")
    assert heat["source"] == "belt" and heat["most_W"] == pytest.approx(120 * 0.5**1.5)
    assert heat["mean_W"] == pytest.approx(0.75 * heat["most_W"]) and heat["energy_Wh"] == heat["mean_W"] / 3


def test_noise_follows_the_seed_alone(small: Path, tmp_path: Path) -> None:
    plan = tmp_path / "plan.yml"
    clean, one, same, other = (
        simulated(small, plan, tmp_path / f"o{k}", noise=k > 0, seed=(0, 1, 1, 2)[k]) for k in range(4)
    )
    assert one.table.equals(same.table) and not one.table["z"].equals(other.table["z"])
    np.testing.assert_array_equal(one.values("z"), np.rint(one.values("z")))  # the probe's resolution
    np.testing.assert_allclose(one.values("t_shaft") * 10, np.rint(one.values("t_shaft") * 10), atol=1e-9)
    np.testing.assert_array_equal(one.values("rpm"), clean.values("rpm"))
    assert 0.1 < np.std(one.values("z") - clean.values("z")) < 2.0
    assert one.labels["noise_seed"] == 1 and clean.labels["noise_seed"] is None


def test_rows_at_the_step_that_was_asked_for(small: Path, tmp_path: Path) -> None:
    fine = simulated(small, tmp_path / "plan.yml", tmp_path / "fine")
    coarse = simulated(small, tmp_path / "plan.yml", tmp_path / "coarse", step_s=60.0)
    assert (fine.step_s, coarse.step_s, coarse.n_rows) == (10.0, 60.0, 21)
    pd.testing.assert_frame_equal(coarse.table, fine.table[::6].reset_index(drop=True))


@pytest.mark.usefixtures("plain_pages")
def test_json_for_machines(call: Call, small: Path) -> None:
    done = call("simulate", "plan.yml", "--machine", small, "--json")
    told = json.loads(done.out)
    assert told["simulated"] is True and told["overview"] == "simulated/overview.png"
    assert told["plans"][0]["errors"][0]["at_1h"] is None and told["plans"][0]["hottest"]["body"] == "shaft"


@pytest.mark.usefixtures("plain_pages")
def test_a_machine_without_error_channels_gets_no_report(call: Call, small: Path, tmp_path: Path) -> None:
    raw = {**TWO_BODIES, "channels": {n: c for n, c in TWO_BODIES["channels"].items() if n != "z"}}
    raw["twin"] = {k: v for k, v in TWO_BODIES["twin"].items() if k != "errors"}
    small.write_text(yaml.safe_dump(raw, sort_keys=False))
    done = call("simulate", "plan.yml", "--machine", small)
    assert done.code == 0 and "report" not in done.out
    assert sorted(p.name for p in (tmp_path / "simulated").iterdir()) == ["overview.png", "plan.parquet", "twin.html"]


@pytest.mark.parametrize(
    ("change", "args", "line"),
    [
        ("rpm: 3000|spindle: 3000", (), "plan.yml: stage 2: unknown key 'spindle'; "),
        ("room: 21|hall: 21", (), "plan.yml: unknown surrounding 'hall'; "),
        (
            "21 degC}|21 degC}\nstart: {bed: 20 degC}",
            (),
            "plan.yml: start: unknown body 'bed'; did you mean 'head'? Allowed: head, shaft",
        ),
        ("", ("--step", "7"), "--step: got 7 s, expected a whole number of the plan's steps of 10 s (plan.yml)"),
        ("", ("--step", "2000"), "--step: 2000 s leaves 1 row of plan.yml, which lasts 1200 s; expected 2 or more"),
        ("", ("--seed", "-1"), "--seed: got -1, expected 0 or more"),
        ("", ("--begins", "soon"), "--begins: got 'soon', expected a local date and time such as '2025-07-15 06:30'"),
        ("", ("--out", "two.yml"), "--out two.yml: is a file, expected a folder; give another --out"),
        ("", ("--out", "two.yml/deep"), "--out two.yml/deep: cannot be written (Not a directory); give another folder"),
        ("", ("copy/plan.yml",), "plan.yml and copy/plan.yml would both be written as plan.parquet; rename one"),
        ("", ("missing.yml",), "run plan missing.yml: cannot be read (No such file"),
        ("", ("--sample-year",), "--sample-year has its own machine and plans; leave out --machine and PLANS"),
    ],
)
def test_bad_input_is_one_line(
    call: Call, small: Path, tmp_path: Path, change: str, args: tuple[str, ...], line: str
) -> None:
    plan = tmp_path / "plan.yml"
    if change:
        plan.write_text(plan.read_text().replace(*change.split("|")))
    done = call("simulate", "plan.yml", "--machine", "two.yml", *args)
    assert done.code == 2 and line in done.err and len(done.err.strip().splitlines()) == 1
    assert not (tmp_path / "simulated").exists()


@pytest.mark.usefixtures("plain_pages")
def test_what_is_there_is_kept(call: Call, small: Path, tmp_path: Path) -> None:
    assert call("simulate", "plan.yml", "--machine", small).code == 0
    file = tmp_path / "simulated" / "plan.parquet"
    before = file.read_bytes()
    done = call("simulate", "plan.yml", "--machine", small, "--noise")
    assert done.code == 2 and "simulated/plan.parquet exists; give another --out, or --overwrite" in done.err
    assert file.read_bytes() == before
    assert call("simulate", "plan.yml", "--machine", small, "--noise", "--overwrite").code == 0
    assert file.read_bytes() != before and not list(tmp_path.glob("simulated/.*"))


def test_a_machine_without_twin_part_or_half_a_call(call: Call, small: Path) -> None:
    raw = {k: v for k, v in TWO_BODIES.items() if k != "twin"}
    Path("plain.yml").write_text(yaml.safe_dump(raw, sort_keys=False))
    done = call("simulate", "plan.yml", "--machine", "plain.yml")
    assert done.code == 2 and "machine file plain.yml: key 'twin' is missing; add bodies" in done.err
    done = call("simulate", "plan.yml")
    assert done.code == 2 and "got a run plan and no machine; give its file by --machine" in done.err
    done = call("simulate", "--machine", small)
    assert done.code == 2 and "got no run plan; name one or more" in done.err
