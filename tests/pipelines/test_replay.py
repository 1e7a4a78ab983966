"""A small year arrives run by run: each run is predicted before it is learned; disturbances end in the same lake."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from data.errors import InputError
from data.lake import Lake
from features.rises import zeroed_error_um
from models.metrics import residual_std_um
from models.selection.crossing import Plan
from models.selection.replay import Replay
from pipelines import settings
from pipelines.caller import DirectCaller
from pipelines.commands.replay import replay_year, worth, write_replay_files
from pipelines.jobs.replay import Progress, ReplayRequest, at_home, replay, settings_below
from pipelines.store import model_store, registry, tracking
from tests.toys.small_year import NOISE_UM, law_um, recording, write_machine

PLAN = Plan(("none",), ("zero", "mlr"), ("leave-batch-out",))
RUNS, START, EVERY = 9, 6, 2
MODEL = "replayed-z"


def day(k: int) -> pd.DataFrame:
    """In the first six the bed follows the front, so that their two gains cannot be told apart; later it does not."""
    table = recording(k)
    rng = np.random.default_rng(100 + k)
    if k < START:
        table["bed"] = table["bed"].iloc[0] + 0.4 * (table["front"] - table["front"].iloc[0])
        table["bed"] = (table["bed"] + rng.normal(0, 0.02, len(table))).round(2)
    else:
        table["bed"] += 4.0 * np.sin(table["time_s"] / 4000.0)
    table["z"] = (law_um(table) + rng.normal(0, NOISE_UM, len(table))).round(1)
    return table


def write_days(folder: Path, n: int = RUNS) -> Path:
    """Runs a week apart."""
    folder.mkdir()
    for k in range(n):
        begun = pd.Timestamp("2025-01-06") + pd.Timedelta(days=7 * k)
        day(k).to_csv(folder / f"{begun:%Y%m%d}.csv", index=False)
    return folder


class Given:
    """A year and a machine, and replays of it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.machine, self.year = (
            folder,
            write_machine(folder / "m.yml", "replayed"),
            write_days(folder / "in"),
        )

    def request(self, name: str, seed: int | None = None, **more: Any) -> ReplayRequest:
        given = {"start": START, "every": EVERY, "seed": seed, "workers": 1} | more
        return ReplayRequest(self.machine, (self.year,), self.folder / name, ("z",), PLAN, **given)

    def replay(self, name: str, seed: int | None = None, **more: Any) -> Replay:
        return replay(self.request(name, seed, **more), settings.load(), DirectCaller())

    def below(self, name: str) -> settings.Settings:
        return settings_below(self.request(name).home, settings.load())


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Given:
    return Given(tmp_path_factory.mktemp("replay"))


@pytest.fixture(scope="module")
def recorded(given: Given) -> Replay:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("THERMODRIFT_HOME", str(given.folder / "mine"))
        result = replay_year(given.request("recorded"), lambda text: None, lambda step, n, of: None)
    assert not (given.folder / "mine").exists()
    return result


@pytest.mark.slow
def test_every_run_is_predicted_by_a_champion_that_has_not_seen_it(recorded: Replay, given: Given) -> None:
    assert [g.n_batches for g in recorded.retrainings] == [6, 8, 9]
    runs = recorded.runs_of("z")
    assert [r.retraining for r in runs] == [1, 1, 2]
    store = given.below("recorded")
    client = tracking.open_store(store)
    for r in runs:
        version = registry.find_version(client, MODEL, str(r.champion))
        learned = tracking.load_training(version.tags["training_id"], store).result.batches["batch_id"]
        assert r.batch_id not in set(learned) and len(learned) <= START + EVERY * (r.retraining - 1)


def test_errors_are_those_of_the_models_by_hand(recorded: Replay, given: Given) -> None:
    with at_home(given.request("recorded").home):
        lake = Lake(given.request("recorded").home / "lake")
        first = next(g.after for g in recorded.retrainings if g.after is not None)
        for r in recorded.runs_of("z"):
            batch = lake.load("replayed", r.batch_id)
            true_um = zeroed_error_um(batch, "z")
            assert r.none_S_um == pytest.approx(residual_std_um(true_um))
            for version, S_um in ((r.champion, r.S_um), (first, r.frozen_S_um)):
                source = registry.find_version(tracking.open_store(given.below("recorded")), MODEL, str(version)).source
                model = model_store.load(Path(registry.local_folder(source, given.below("recorded"))))
                assert S_um == pytest.approx(residual_std_um(true_um - model.predict(batch)))
    s = recorded.score("z")
    assert s.n == 3 and s.S_um < s.none_S_um / 4
    assert 0 <= s.covered <= s.bounded == 3


@pytest.mark.slow
def test_the_retraining_that_learned_the_bed_is_promoted_and_worth_it(recorded: Replay) -> None:
    first, second, last = recorded.retrainings
    assert (first.before, first.after, first.outcome) == (None, 1, "champion")
    assert (second.before, second.after, second.outcome) == (1, 2, "champion") and second.promoted
    assert "against version 1" in second.why and last.before == 2
    (before, _), (after,) = recorded.runs_of("z", 1), recorded.runs_of("z", 2)
    assert before.S_um == before.frozen_S_um and after.champion == 2
    assert after.S_um < 4 * NOISE_UM and after.frozen_S_um > 2 * after.S_um
    score = recorded.score("z", 2)
    assert score.retrained == 1 and score.against_frozen.difference_um == pytest.approx(after.frozen_S_um - after.S_um)


@pytest.mark.slow
def test_the_page_and_the_json_say_the_same(recorded: Replay, tmp_path: Path) -> None:
    text, page = (p.read_text(encoding="utf-8") for p in write_replay_files(recorded, tmp_path))
    plain, s = json.loads(text), recorded.score("z")
    assert plain["schema"] == "thermodrift.replay/1" and len(plain["runs"]) == 3
    assert plain["scores"]["z"]["all"]["S_um"] == pytest.approx(s.S_um)
    assert f"<dd><span>{s.S_um:.2f} µm</span>" in page and f"<dd><span>{s.none_S_um:.2f} µm</span>" in page
    assert "SIMULATED" in page and page.count("promoted</span>") == sum(g.promoted for g in recorded.retrainings)
    assert "http" not in page.replace("http://www.w3.org", "").replace("http-equiv", "")
    assert f"{s.n} runs: S {s.S_um:.2f} µm" in worth(recorded, "z")


@pytest.mark.slow
def test_what_is_done_is_not_done_again(recorded: Replay, given: Given) -> None:
    before = (given.folder / "recorded" / "progress.json").stat().st_mtime_ns
    assert given.replay("recorded") == recorded
    assert (given.folder / "recorded" / "progress.json").stat().st_mtime_ns == before
    with pytest.raises(
        InputError, match="holds a replay with other every; give the same to go on with it, or another folder"
    ):
        given.replay("recorded", every=3)


def test_what_makes_no_replay_is_refused(given: Given, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"got 9 runs, of which --start 20 are learned first"):
        given.replay("none", start=20)
    with pytest.raises(InputError, match="--every: got 0, expected 1 or more"):
        given.replay("none", every=0)
    assert not (given.folder / "none").exists()


@pytest.mark.slow
def test_disturbed_arrivals_end_in_the_same_lake_and_the_same_kind_of_champion(recorded: Replay, given: Given) -> None:
    disturbed = given.replay("disturbed", seed=4)
    assert {a.how for a in disturbed.arrivals} >= {"late", "again", "faulty", "corrected", "out of order"}
    homes = [given.request(name).home for name in ("recorded", "disturbed")]
    one, other = (Lake(h / "lake") for h in homes)
    assert one.batch_ids("replayed") == other.batch_ids("replayed")
    for name in one.batch_ids("replayed"):
        assert one.load("replayed", name).digest == other.load("replayed", name).digest
    assert {r.batch_id for r in disturbed.runs} and len({r.batch_id for r in disturbed.runs}) == len(disturbed.runs)


@pytest.mark.slow
def test_duplicates_change_nothing(recorded: Replay, given: Given, monkeypatch: pytest.MonkeyPatch) -> None:
    """With copies as the only disturbance, every champion and every error is that of the year as recorded."""
    import pipelines.jobs.replay as module
    from models.selection.replay import Arrival

    def twice(ids: Any, seed: int | None = None) -> tuple[Arrival, ...]:
        both = [a for name in ids for a in (Arrival(0, name, "as recorded"),
                                            Arrival(0, name, "again", first=False, new=False))]  # fmt: skip
        return tuple(Arrival(n, a.batch_id, a.how, a.fault, a.first, a.new) for n, a in enumerate(both, 1))

    monkeypatch.setattr(module, "arrivals", twice)
    copied = given.replay("copied", seed=1)
    assert len(copied.arrivals) == 2 * RUNS
    for a, b in zip(recorded.runs_of("z"), copied.runs_of("z"), strict=True):
        assert (a.batch_id, a.champion) == (b.batch_id, b.champion)
        assert (a.S_um, a.bound90_S_um) == pytest.approx((b.S_um, b.bound90_S_um), rel=1e-12)
    assert Lake(given.request("copied").home / "lake").batch_ids("replayed") == sorted(
        f.stem for f in given.year.iterdir()
    )


@pytest.mark.slow
def test_a_replay_that_was_stopped_goes_on(recorded: Replay, given: Given, monkeypatch: pytest.MonkeyPatch) -> None:
    write = Progress.write

    def stop(self: Progress) -> None:
        if self.arrived == 8 and not os.environ.get("GOES_ON"):
            raise KeyboardInterrupt
        write(self)

    monkeypatch.setattr(Progress, "write", stop)
    with pytest.raises(KeyboardInterrupt):
        given.replay("stopped")
    monkeypatch.setenv("GOES_ON", "1")
    again = given.replay("stopped")
    for a, b in zip(recorded.runs_of("z"), again.runs_of("z"), strict=True):
        assert (a.batch_id, a.champion, a.S_um) == (b.batch_id, b.champion, pytest.approx(b.S_um))
    assert [(g.after, g.outcome, g.why) for g in again.retrainings] == [
        (g.after, g.outcome, g.why) for g in recorded.retrainings
    ]


@pytest.mark.slow
def test_the_command_and_recordings_with_several_runs_in_a_file(tmp_path: Path) -> None:
    """A file that holds several runs is delivered run by run."""
    machine = write_machine(tmp_path / "m.yml", "replayed")
    text = machine.read_text(encoding="utf-8")
    machine.write_text(
        text.replace("  max_gap_s: 900\n", "  max_gap_s: 900\n  split: {driver: speed, min_run_s: 600}\n")
    )
    (tmp_path / "in").mkdir()
    parts = []
    for k in range(9):
        table = recording(k)
        table["time_s"] += k * 30000.0
        rest = table.tail(1).assign(speed=0.0, time_s=table["time_s"].iloc[-1] + 300.0)
        parts += [table, rest]
    pd.concat(parts).to_csv(tmp_path / "in" / "20250101.csv", index=False)
    request = ReplayRequest(machine, (tmp_path / "in",), tmp_path / "out", ("z",), PLAN, 6, 2, workers=1)
    result = replay_year(request, lambda text: None, lambda step, n, of: None)
    assert len(result.runs) == 3 and (tmp_path / "out" / "replay.html").is_file()
    assert all(math.isfinite(r.none_S_um) for r in result.runs)
    assert np.all(np.diff([r.arrival for r in result.runs]) > 0)
