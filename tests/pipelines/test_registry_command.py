"""The log of champions and `thermodrift registry`: who was champion when, why, and what a version was made from."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from mlflow.tracking import MlflowClient

import thermodrift as td
from data.errors import InputError
from pipelines.store import audit, registry, runs, tracking
from tests.toys.command import Call, in_process
from tests.toys.tracked import client_of, newcomer
from tests.toys.training import toy_batches

MASKED = {"batch_id": "b02", "check": "spike", "channel": "front", "start_s": 60.0, "end_s": 120.0,
          "words": "front jumps", "masks": True, "overruled": ""}  # fmt: skip
FINDINGS = (
    MASKED,
    {**MASKED, "channel": "bed", "overruled": "checked by hand"},
    {**MASKED, "batch_id": "b03", "channel": "z", "masks": False},
    {**MASKED, "batch_id": "b04", "channel": None},
)


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], store_home: Path) -> Call:
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    return in_process(monkeypatch, capsys)


@pytest.fixture(autouse=True, scope="module")
def zone() -> Iterator[None]:
    """An hour ahead of UTC, two in summer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TZ", "Europe/Berlin")
        time.tzset()
        yield
    time.tzset()


def train(store: Any, machine: str, S_um: list[float], at: str = "", *, force: bool = False) -> registry.Promotion:
    """Log and promote a training over len(S_um) batches, at a time (UTC)."""
    new = newcomer(store, machine, S_um, findings=FINDINGS)
    with clock(at):
        return registry.promote(new, store, force=force)


def clock(at: str) -> Any:
    patch = pytest.MonkeyPatch()

    class Set:
        def __enter__(self) -> None:
            if at:
                patch.setattr(audit, "now", lambda: datetime.fromisoformat(at).replace(tzinfo=UTC))

        def __exit__(self, *_: object) -> None:
            patch.undo()

    return Set()


def log_of(store: Any, name: str) -> audit.Log:
    return audit.read(client_of(store).get_registered_model(name))


@dataclass(frozen=True)
class Story:
    name: str
    promotions: list[registry.Promotion]
    outcome_before: list[str]


@pytest.fixture(scope="module")
def story(store: Any) -> Story:
    """Version 1 on 1 March, 2 on 2 March, roll-back on 3 March, version 3 on 4 March, version 4 by force on 5 March."""
    base = [5.0, 6.0, 5.5, 6.5, 5.0, 6.0]
    one = train(store, "audit", base, "2026-03-01T09:00")
    two = train(store, "audit", [*(s - 1 for s in base), 5.0], "2026-03-02T09:00")
    champion = _mark(store, two)
    with clock("2026-03-03T09:00"):
        back = registry.rollback("audit-z", store, "the spindle was repaired")
    former = _mark(store, two)
    three = train(store, "audit", [*(s - 2 for s in base), 5.0, 5.0], "2026-03-04T09:00")
    four = train(store, "audit", [9.0] * 9, "2026-03-05T09:00", force=True)
    return Story("audit-z", [one, two, back, three, four], [champion, former])


def _mark(store: Any, promotion: registry.Promotion) -> str:
    from reports.comparison.story import mark_of

    tags = client_of(store).get_model_version(promotion.name, str(promotion.version)).tags
    return mark_of(tracking.load_training(tags["training_id"], store))


@pytest.mark.parametrize(
    ("at", "version"),
    [("2026-03-01T09:00Z", 1), ("2026-03-02T08:59:59Z", 1), ("2026-03-02T09:00Z", 2), ("2026-03-02T23:00Z", 2),
     ("2026-03-03T09:00Z", 1), ("2026-03-04T08:00Z", 1), ("2026-03-04T09:00Z", 3), ("2026-03-05T10:00", 4),
     ("2026-03-05T09:59", 3), (datetime(2026, 3, 3, 9, 59), 2), (datetime(2026, 3, 3, 10, 0), 1)],
)  # fmt: skip
def test_the_champion_at_every_time(story: Story, store_home: Path, monkeypatch: Any, at: Any, version: int) -> None:
    """Times without a zone are those of Berlin."""
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    table = td.registry(story.name, at=at)
    assert table["version"].tolist() == [version]


def test_a_day_has_every_champion_of_that_day(story: Story, store_home: Path, monkeypatch: Any) -> None:
    monkeypatch.setenv("THERMODRIFT_HOME", str(store_home))
    table = td.registry(machine="audit", at="2026-03-03")
    assert table["version"].tolist() == [2, 1]
    assert table["since"].tolist() == [pd.Timestamp("2026-03-02T09:00Z"), pd.Timestamp("2026-03-03T09:00Z")]
    assert table["until"].tolist() == [pd.Timestamp("2026-03-03T09:00Z"), pd.Timestamp("2026-03-04T09:00Z")]
    assert td.registry(story.name, at=date(2026, 3, 6))["version"].tolist() == [4]
    assert td.registry(story.name, at="2026-03-01")["version"].tolist() == [1]


def test_every_change_is_an_entry(story: Story, store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    log = log_of(store, story.name)
    assert [(e.action, e.from_version, e.to_version, e.forced) for e in log.entries] == [
        ("promote", None, 1, False), ("promote", 1, 2, False), ("rollback", 2, 1, False), ("promote", 1, 3, False),
        ("promote", 3, 4, True),
    ]  # fmt: skip
    assert all(log.carried_out)
    assert log.entries[0].why == "first champion of this machine and channel"
    assert log.entries[1].why.startswith("against version 1: ")
    assert log.entries[2].why == "the spindle was repaired"
    assert log.entries[4].why.startswith("by force; against version 3: ")
    for entry in log.entries:
        tags = client_of(store).get_model_version(story.name, str(entry.to_version)).tags
        assert entry.training_id == tags["training_id"] and entry.who and entry.model == story.name
        assert entry.code_version == runs.code_version() == tags["code_version"]
        assert entry.code_version.startswith(("git ", "thermodrift "))


def test_the_log_is_plain_json_in_the_registry(story: Story, store: Any) -> None:
    tags = client_of(store).get_registered_model(story.name).tags
    entries = {k: json.loads(v) for k, v in tags.items() if k.startswith("thermodrift.log.") and "done" not in k}
    assert len(entries) == 5 and sorted(entries) == list(entries)
    assert next(iter(entries.values()))["when"] == "2026-03-01T09:00:00Z"
    assert set(next(iter(entries.values()))) == set(audit.Entry.model_fields)


def test_who_is_the_user_of_the_tracking_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "anna")
    assert audit.who() == "anna"
    monkeypatch.delenv("MLFLOW_TRACKING_USERNAME")
    monkeypatch.setattr(audit.getpass, "getuser", lambda: (_ for _ in ()).throw(KeyError("uid 1234")))
    assert audit.who() == "unknown"


def test_status_and_reports_know_the_roll_back(story: Story, store: Any) -> None:
    assert story.outcome_before == ["champion", "former champion"]
    table = registry.status(store)
    ends = table[table["name"] == story.name].set_index("version")["was_champion_until"]
    assert ends.to_dict() == {
        4: "", 3: "2026-03-05T09:00:00+00:00", 2: "2026-03-03T09:00:00+00:00", 1: "2026-03-04T09:00:00+00:00",
    }  # fmt: skip


def test_the_command_lists_champions(story: Story, call: Call) -> None:
    done = call("registry", "--machine", "audit")
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith("audit-z: champion version 4 since 2026-03-05 10:00:00 CET (promote by ")
    assert done.out.strip().endswith("; versions: 4")
    (row,) = json.loads(call("registry", "--machine", "audit", "--json").out)
    assert (row["champion"], row["versions"], row["since"][:16]) == (4, 4, "2026-03-05T09:00")
    names = [m["model"] for m in json.loads(call("registry", "--json").out)]
    assert "audit-z" in names and names == sorted(names)


def test_the_command_prints_a_history(story: Story, call: Call) -> None:
    done = call("registry", story.name)
    lines = done.out.splitlines()
    assert (done.code, len(lines)) == (0, 11)
    assert lines[0] == "audit-z, times are local"
    assert lines[1].startswith("  2026-03-01 10:00:00 CET promote none → 1, ")
    assert lines[5].startswith("  2026-03-03 10:00:00 CET rollback 2 → 1, ") and lines[5].endswith("was repaired")
    assert lines[2].startswith("    training ") and runs.code_version() in lines[2]
    rows = json.loads(call("registry", story.name, "--json").out)
    assert [(r["from_version"], r["to_version"], r["carried_out"]) for r in rows][:2] == [(None, 1, True), (1, 2, True)]


def test_the_command_states_the_zone_of_a_time(story: Story, call: Call) -> None:
    done = call("registry", story.name, "--at", "2026-03-03T10:00")
    first, second = done.out.splitlines()
    assert first == "at 2026-03-03 10:00:00 CET (2026-03-03 09:00:00 UTC)"
    assert second.startswith(
        "  audit-z: version 1, since 2026-03-03 10:00:00 CET until 2026-03-04 10:00:00 CET; rollback"
    )
    done = call("registry", "--machine", "audit", "--at", "2026-03-06", "--json")
    got = json.loads(done.out)
    assert (got["from"], got["until"]) == ("2026-03-05T23:00:00+00:00", "2026-03-06T23:00:00+00:00")
    assert [(c["version"], c["until"]) for c in got["champions"]] == [(4, None)]
    first = call("registry", story.name, "--at", "2026-03-06").out.splitlines()[0]
    assert first == "on 2026-03-06 (local day, 2026-03-05 23:00 to 2026-03-06 23:00 UTC)"


def test_a_lineage_names_every_batch_with_its_digest(story: Story, store: Any, call: Call) -> None:
    done = call("registry", f"{story.name}/3", "--lineage", "--json")
    got = json.loads(done.out)
    batches = toy_batches("audit", 8)
    assert {b["batch_id"]: b["digest"] for b in got["batches"]} == {b.batch_id: b.digest for b in batches}
    assert {b["batch_id"]: b["masked"] for b in got["batches"] if b["masked"]} == {"b02": "front", "b04": "*"}
    assert len(got["findings"]) == 4 and got["inputs"] == ["front", "bed"] and got["simulated"]
    assert got["training_code_version"] == got["code_version"] == runs.code_version()
    tags = client_of(store).get_model_version(story.name, "3").tags
    assert (got["version"], got["training_id"], got["cell"]) == (3, tags["training_id"], "none|mlr|2")
    assert got["champion"] == [["2026-03-04T09:00:00+00:00", "2026-03-05T09:00:00+00:00"]]
    shown = call("registry", f"models:/{story.name}/3", "--lineage")
    assert all(b.batch_id in shown.out and b.digest[:12] in shown.out for b in batches)
    assert f"training {tags['training_id']}" in shown.out and "all channels" in shown.out
    assert shown.out.splitlines()[-4:] == [
        "  spike: front in 1 batch (b02), masked",
        "  spike: bed in 1 batch (b02), noted, not masked",
        "  spike: z in 1 batch (b03), noted, not masked",
        "  spike: all channels in 1 batch (b04), masked",
    ]
    table = td.registry(f"{story.name}/3", lineage=True)
    assert table["digest"].tolist() == [b.digest for b in batches] and table.attrs["version"] == 3


def test_a_lineage_at_a_time_is_that_of_the_champion(story: Story, call: Call) -> None:
    def version(*args: str) -> int:
        return int(json.loads(call("registry", story.name, "--lineage", "--json", *args).out)["version"])

    assert (version(), version("--at", "2026-03-02T12:00")) == (4, 2)
    done = call("registry", story.name, "--lineage", "--at", "2026-03-03")
    assert done.code == 2 and "had several champions on 2026-03-03" in done.err and "versions 2, 1;" in done.err


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (["adit-z"], "unknown model 'adit-z'; did you mean 'audit-z'?"),
        (["audit-z/9", "--lineage"], "model 'audit-z' has no version '9'; "),
        (["--machine", "adit"], "--machine: no registered model of machine 'adit'; did you mean 'audit'?"),
        (["audit-z", "--at", "2026-02-28T10:00"],
         "model 'audit-z' had no recorded champion at 2026-02-28 10:00:00 CET (2026-02-28 09:00:00 UTC); its "
         "first promotion was at 2026-03-01 10:00:00 CET; `thermodrift registry audit-z` lists its history"),
        (["--machine", "audit", "--at", "1999-12-31"], "model 'audit-z' had no recorded champion on 1999-12-31 ("),
        (["--at", "3 March"], "time '3 March': expected a day such as 2026-03-03, or a time such as"),
        (["--at", "0001-01-01"], "time '0001-01-01': expected a day"),
        (["--at", "9998-01-01"], "time '9998-01-01': on 9998-01-01 (local day, "),
        (["audit-z/3"], "registry: got 'audit-z/3'; a version has a lineage: add --lineage, or give 'audit-z' alone"),
        (["a/b/c"], "registry: got 'a/b/c', expected NAME"),
        (["--lineage"], "registry --lineage: no model; expected NAME/VERSION"),
        (["audit-z/3", "--lineage", "--at", "2026-03-03"], "registry --lineage: got the version 3 and --at"),
        (["audit-z", "--machine", "audit"], "registry: got the model 'audit-z' and --machine audit; give one"),
    ],
)  # fmt: skip
def test_what_cannot_be_answered_is_one_line(story: Story, call: Call, args: list[str], line: str) -> None:
    done = call("registry", *args)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert done.err.startswith(f"thermodrift: {line}")


@pytest.mark.slow
def test_every_prefix_of_a_promotion_is_consistent(store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process dies at the first, second and third write of a promotion; look-ups now and after the next one."""
    writes = ["entry", "alias", "done"]
    for dies_at in range(3):
        machine, base = f"cut-{writes[dies_at]}", [5.0, 6.0, 5.5, 6.5, 5.0, 6.0]
        name = f"{machine}-z"
        train(store, machine, base, "2026-04-01T09:00")
        better = [*(s - 1 for s in base), 5.0]
        with monkeypatch.context() as patch:
            _die(patch, name, dies_at)
            with pytest.raises(OSError, match="power cut"):
                train(store, machine, better, "2026-04-02T09:00")
        moved = dies_at == 2
        log = log_of(store, name)
        assert log.champion == (2 if moved else 1)
        assert [r.version for r in log.champions(audit.span_of("2026-04-03T09:00Z"))] == [log.champion]
        assert log.carried_out == ((True,), (True, False), (True, True))[dies_at]
        # The next promotion states in its entry what the alias named, so the answer about the past stays.
        train(store, machine, [9.0] * 8, "2026-04-04T09:00", force=True)
        log = log_of(store, name)
        before = [r.version for r in log.champions(audit.span_of("2026-04-03T09:00Z"))]
        assert before == [2 if moved else 1] and not any(r.note for r in log.reigns)
        assert [r.version for r in log.champions(audit.span_of("2026-04-05T09:00Z"))] == [log.champion] == [3]


def _die(patch: pytest.MonkeyPatch, name: str, at: int) -> None:
    """Let the n-th write of the change of a champion fail, and every later write of any kind."""
    count = 0

    def guard(method: str, counts: Any) -> None:
        real = getattr(MlflowClient, method)

        def write(self: MlflowClient, *args: Any, **kwargs: Any) -> Any:
            nonlocal count
            if counts(*args):
                count += 1
            if count > at:
                raise OSError("power cut")
            return real(self, *args, **kwargs)

        patch.setattr(MlflowClient, method, write)

    guard("set_registered_model_tag", lambda model, key, value: key.startswith("thermodrift.log."))
    guard("set_registered_model_alias", lambda *args: True)
    guard("set_model_version_tag", lambda *args: False)


def test_an_interrupted_promotion_stays_in_the_history(store: Any, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    train(store, "cut-shown", [5.0] * 6, "2026-04-01T09:00")
    with monkeypatch.context() as patch:
        _die(patch, "cut-shown-z", 1)
        with pytest.raises(OSError, match="power cut"):
            train(store, "cut-shown", [4.0] * 7, "2026-04-02T09:00")
    done = call("registry", "cut-shown-z")
    assert done.out.strip().endswith("interrupted, or still running: the champion did not change")
    assert "champion version 1 since 2026-04-01 11:00:00 CEST" in call("registry", "--machine", "cut-shown").out


def test_an_alias_that_was_moved_elsewhere_is_noted(store: Any, call: Call) -> None:
    train(store, "moved", [5.0] * 6, "2026-04-01T09:00")
    train(store, "moved", [4.0] * 7, "2026-04-02T09:00")
    client_of(store).set_registered_model_alias("moved-z", "champion", "1")
    note = "later the alias named version 1: changed outside thermodrift or by two machines at the same time"
    line = call("registry", "--machine", "moved").out.strip()
    assert line == f"moved-z: champion version 1; versions: 2; {note}"
    train(store, "moved", [9.0] * 8, "2026-04-04T09:00", force=True)
    log = log_of(store, "moved-z")
    assert [(r.version, r.note) for r in log.reigns] == [(1, ""), (2, note), (3, "")]


def test_a_champion_from_before_the_log_is_not_guessed(store: Any, call: Call) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(audit, "move_champion", lambda client, name, version, **_: client.set_registered_model_alias(
            name, "champion", version))  # fmt: skip
        train(store, "old", [5.0] * 6)
    line = call("registry", "--machine", "old").out.strip()
    said = "version 1 became champion outside the log; since when is not recorded"
    assert line == f"old-z: champion version 1; versions: 1; {said}"
    assert call("registry", "old-z").out.splitlines()[1].startswith("  no entry; ")
    done = call("registry", "old-z", "--at", "2026-04-01")
    assert done.code == 2 and said in done.err
    train(store, "old", [4.0] * 7, "2026-04-02T09:00")
    done = call("registry", "old-z", "--at", "2026-04-01")
    assert "its log begins at 2026-04-02 11:00:00 CEST, when version 1 was champion; before, nothing" in done.err
    assert call("registry", "old-z", "--at", "2026-04-03").code == 0


def test_a_damaged_entry_is_named(store: Any, call: Call) -> None:
    train(store, "damaged", [5.0] * 6)
    client = client_of(store)
    key = next(k for k in client.get_registered_model("damaged-z").tags if k.startswith("thermodrift.log."))
    before = client.get_registered_model("damaged-z").tags[key]
    client.set_registered_model_tag("damaged-z", key, "{")
    done = call("registry", "damaged-z")
    said = f"model 'damaged-z': the log entry in tag '{key}' cannot be read; "
    assert done.code == 1 and done.err.startswith(f"thermodrift: {said}")
    # The other models stay readable.
    assert f"damaged-z: champion version 1; versions: 1; {said}" in call("registry").out
    assert call("status").code == 0
    client.set_registered_model_tag("damaged-z", key, before)


def entry(day: int, before: int | None, version: int) -> audit.Entry:
    return audit.Entry(
        when=datetime(2026, 5, day, tzinfo=UTC), who="anna", host="hall", action="promote", model="m",
        from_version=before, to_version=version, why="", forced=False, training_id="t", code_version="c",
    )  # fmt: skip


def test_clocks_that_differ_leave_one_champion_at_every_time() -> None:
    """The second machine's clock is four days late, so its entry has an earlier time than the one before."""
    log = audit.Log("m", "", "", 3, (entry(1, None, 1), entry(9, 1, 2), entry(5, 2, 3)), (True, True, True))
    for day, versions in ((2, [1]), (4, [1]), (5, [3]), (7, [3]), (10, [3])):
        at = datetime(2026, 5, day, 12, tzinfo=UTC)
        assert [r.version for r in log.champions(audit.Span(at, at))] == versions


def test_a_day_of_the_change_to_summer_time_has_23_hours() -> None:
    span = audit.span_of("2026-03-29")
    assert span.end - span.start == timedelta(hours=23)
    assert audit.span_of("2026-03-29T12:00").start == datetime(2026, 3, 29, 10, tzinfo=UTC)


def test_an_empty_registry_is_one_line(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path))
    done = call("registry")
    assert (done.code, done.out) == (0, "no model is registered; `thermodrift train` promotes the first\n")
    assert call("registry", "--json").out == "[]\n"
    assert td.registry().empty and "champion" in td.registry()
    with pytest.raises(InputError, match="unknown model 'a'; the registry is empty; train first"):
        td.registry("a")
    assert os.environ["THERMODRIFT_HOME"] == str(tmp_path)
