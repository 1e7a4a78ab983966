"""`thermodrift describe --twin`: tables on the console, a picture on request, one line where it cannot."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from pipelines import cli, console
from pipelines.commands.describe import describe_twin
from tests.toys.command import Call
from tests.twin.machines import TWO_BODIES

pytestmark = pytest.mark.drawn
MACHINES = Path(cli.__file__).resolve().parents[1] / "machines"


@pytest.fixture
def two(tmp_path: Path) -> Path:
    path = tmp_path / "two.yml"
    path.write_text(yaml.safe_dump(TWO_BODIES, sort_keys=False), encoding="utf-8")
    return path


def test_tables_and_picture_of_the_sample_machine(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console.out, "width", 220)  # whatever width an earlier test has set
    out = tmp_path / "network.svg"
    code, said, err = call(
        "describe", "--twin", MACHINES / "sample_vmc.yml", "--at", "spindle_rpm=6 krpm", "--out", out
    )
    assert code == 0 and err == "" and out.read_text(encoding="utf-8").startswith("<?xml")
    assert "sample_vmc (SIMULATED): 14 bodies, 16 links, 17 exposures, 9 sensors; 60 free and 81 fixed" in said
    for words in ("1100 kJ/K", "test mandrel", "bed and table against the room", "7.7 h", "49 min", str(out)):
        assert words in said.replace("\n", " "), words
    assert "spindle_rpm = 6000" in said


def test_without_a_range_from_zero_laws_stand_alone(two: Path) -> None:
    out = two.with_name("two.png")
    assert describe_twin(two, out).view.stated == "" and out.read_bytes().startswith(b"\x89PNG")
    assert describe_twin(two, at=("rpm=6000",)).view.heats[0].watts == pytest.approx(120.0)


def test_the_html_holds_parameters_and_modes(two: Path, tmp_path: Path) -> None:
    out = tmp_path / "twin.html"
    describe_twin(two, out)
    text = out.read_text(encoding="utf-8")
    assert "<h2>Parameters</h2>" in text and "<h2>Time constants and modes</h2>" in text
    assert text.count("data:image/") == 2


@pytest.mark.parametrize(
    ("args", "said"),
    [
        ((), "got nothing to describe; name recordings, or a machine file as --twin MACHINE.yml"),
        (("--twin", MACHINES / "spindle_fl.yml"), "spindle_fl.yml: key 'twin' is missing; add bodies"),
        (("--twin", "gone.yml"), "gone.yml"),
        (("--twin", "TWO", "a.csv"), "reads no recordings; leave out a.csv"),
        (
            ("--twin", "TWO", "--out", "x.pdf"),
            "--out x.pdf: unsupported file extension '.pdf'; give .svg, .png or .html",
        ),
        (("--twin", "TWO", "--out", "TWO.svg"), "exists; give another --out or remove it first"),
        (
            ("--twin", "TWO", "--at", "rmp=3"),
            "got 'rmp', expected a driver and its value, e.g. rpm=1; did you mean 'rpm'",
        ),
        (("--twin", "TWO", "--at", "rpm"), "--at rpm: got 'rpm', expected a driver and its value"),
        (("--twin", "TWO", "--at", "rpm=fast"), "--at rpm=fast: expected a number with a unit such as '1 rpm'"),
        (("--at", "rpm=3", "a.csv"), "--at rpm=3: belongs to a twin's picture; add --twin MACHINE.yml"),
    ],
)
def test_what_cannot_be_described_is_one_line(call: Call, two: Path, args: tuple[object, ...], said: str) -> None:
    two.with_suffix(".svg").write_text("mine", encoding="utf-8")
    names = {"TWO": two, "TWO.svg": two.with_suffix(".svg")}
    code, out, err = call("describe", *(names.get(str(a), a) for a in args))
    assert code == 2 and out == "" and said in err and err.count("\n") == 1 and "Traceback" not in err
    assert two.with_suffix(".svg").read_text(encoding="utf-8") == "mine"
