"""An answering process sees its case and nothing else: each way out is tried, by Python and past it."""

from __future__ import annotations

import json
import os
import socket
from pathlib import Path

import pytest

from data.errors import InputError, WorkError
from tests.proof.toy_suite import HERE, make, sealed, specs
from thermodrift_exam.plants import concealed
from thermodrift_exam.proof.sealing.isolation import allowed, audit_hook, own_source, roots
from thermodrift_exam.proof.sealing.running import RUN, Examinee, examine

CURIOUS = Examinee("toy_examinee:curious", None, import_from=(HERE,))


def case_of(folder: Path, tries: list[tuple[str, str]]) -> Path:
    folder.mkdir()
    make(specs(1, tries)[0], folder)
    return folder


def remarks_of(files: dict[str, bytes]) -> list[str]:
    return list(json.loads(files["findings.json"])["remarks"])


def test_every_way_out_is_shut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path))
    secret = tmp_path / "vault.json"
    secret.write_text("{}")
    elsewhere = tmp_path / "elsewhere.csv"
    with socket.create_server(("127.0.0.1", 0)) as server:
        tries = [
            ("read", str(secret)), ("native read", str(secret)), ("list", str(tmp_path)), ("list", "/"),
            ("write", str(elsewhere)), ("shell", str(secret)), ("connect", str(server.getsockname()[1])),
            ("read", "/proc/1/environ"), ("import", "thermodrift_exam.plants.plant"), ("read", concealed.__file__),
            ("import", "thermodrift_exam.plants.concealed"), ("import", "plants.sample.sample_machine"),
            ("import", "thermodrift_exam.proof.sealing.opening"), ("import", "thermodrift_exam.proof.scoring.matching"),
            ("list", str(Path(concealed.__file__).parent)), ("environment", ""), ("read", "machine.yml"),
            ("list", "recordings"), ("write", "recordings/run_2.csv"),
        ]  # fmt: skip
        files = examine(case_of(tmp_path / "case", tries), CURIOUS, "ab")
    run = json.loads(files[RUN])
    told = dict(zip(tries, (r.split(": ")[1] for r in remarks_of(files)), strict=True))
    landlocked = run["isolation"].startswith("landlock")
    assert run["isolation"] in ("landlock and audit hook", "audit hook")
    seen = {k for k, v in told.items() if not v.endswith("Error")}
    expected = {("environment", ""), ("read", "machine.yml"), ("list", "recordings")}
    assert seen == (expected if landlocked else expected | {("native read", str(secret))})
    assert told["list", "recordings"] == "got 1 names"
    assert "THERMODRIFT" not in told["environment", ""] and "PATH" not in told["environment", ""].split()
    assert not elsewhere.exists() and not (tmp_path / "case" / "recordings" / "run_2.csv").exists()
    assert (run["error"], run["cores"], run["source_digest"]) == (None, 1, "ab")


def test_the_hook_alone_refuses_too(tmp_path: Path) -> None:
    """Where the kernel has no Landlock."""
    (tmp_path / "case").mkdir()
    (tmp_path / "answer").mkdir()
    (tmp_path / "case" / "way_out").symlink_to(tmp_path / "vault")
    hook = audit_hook(allowed(tmp_path))
    own, vault = tmp_path / "case" / "machine.yml", tmp_path / "vault" / "a.json"
    hook("open", (str(own), "r", os.O_RDONLY))
    hook("open", (3, "r", os.O_RDONLY))
    hook("open", (str(tmp_path / "answer" / "findings.json"), "w", os.O_WRONLY | os.O_CREAT))
    hook("os.listdir", (str(own.parent),))
    for event, args in (
        ("open", (str(vault), "r", os.O_RDONLY)),
        ("open", (os.fsencode(vault), "r", os.O_RDONLY)),
        ("open", (str(own.parent / ".." / "vault" / "a.json"), "r", os.O_RDONLY)),
        ("open", (str(own.parent / "way_out" / "a.json"), "r", os.O_RDONLY)),
        ("open", (str(own), "w", os.O_WRONLY)),
        ("os.listdir", (str(tmp_path),)),
        ("os.listdir", (None,)),
        ("os.scandir", ("/",)),
        ("os.rename", (str(tmp_path / "answer" / "a"), str(vault))),
        ("os.symlink", (str(vault), str(own))),
        ("socket.__new__", (None, 2, 1, 0)),
        ("subprocess.Popen", ("/bin/sh", [], None, None)),
        ("os.fork", ()),
    ):
        with pytest.raises(PermissionError):
            hook(event, args)


def test_the_drawing_of_cases_is_no_part_of_what_is_seen() -> None:
    seen = [{p.relative_to(r).as_posix() for p in parts} for r, parts in zip(roots(), own_source(), strict=True)]
    assert seen[0] == {"data", "diagnosis", "twin"}
    assert {p.rpartition("/")[0] for p in seen[1]} == {
        f"thermodrift_exam{below}" for below in ("", "/proof", "/proof/sealing")
    }
    assert all(p.is_file() for p in own_source()[1])


def test_a_proof_does_not_lie_where_it_is_seen() -> None:
    inside = roots()[0] / "twin" / "some_proof"
    with pytest.raises(InputError, match=r"some_proof: lies in .*, which answering processes may read; give another"):
        sealed(inside)
    assert not inside.exists()


@pytest.mark.slow
def test_what_goes_wrong_is_one_line(tmp_path: Path) -> None:
    case = case_of(tmp_path / "case", [])
    for diagnose, limit_s, error in (
        ("broken", 60.0, "ValueError: no fit stays finite"),
        ("dies", 60.0, "ended by signal 6"),
        ("slow", 0.3, "no end within 0.3 s"),
    ):
        files = examine(case, Examinee(f"toy_examinee:{diagnose}", None, limit_s, (HERE,)), "ab")
        run = json.loads(files[RUN])
        assert set(files) == {RUN} and (run["error"], run["rivals_error"]) == (error, None)


@pytest.mark.slow
def test_findings_outlive_rivals_that_fail(tmp_path: Path) -> None:
    by = Examinee("toy_examinee:quick", "toy_examinee:no_rivals", import_from=(HERE,))
    files = examine(case_of(tmp_path / "case", []), by, "ab")
    run = json.loads(files[RUN])
    assert set(files) == {RUN, "findings.json", "next_run.yml", "series.csv"}
    assert (run["error"], run["rivals_error"]) == (None, "rivals: nothing to compare with")


@pytest.mark.slow
def test_a_process_that_cannot_begin_answers_nothing(tmp_path: Path) -> None:
    by = Examinee("toy_examinee:absent", None, import_from=(HERE,))
    with pytest.raises(WorkError, match=r"the answering process did not start: .*has no attribute 'absent'$"):
        examine(case_of(tmp_path / "case", []), by, "ab")
