"""The structured text export: consistent declarations, and equal to the program after translation to Python."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from math import exp
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_exports_programs import PROGRAMS, Batches, dynamic, every_operation, fitted, rows_with_holes

from compensation.exports import EXPORTS
from compensation.exports.base import ExportedAxis
from compensation.exports.structured_text import StructuredTextExport, real
from data.errors import InputError
from models.program import replay
from tests.toys.exported import LIMITS, export_of, offset_only, straight

WORDS = {
    "IF", "THEN", "ELSE", "END_IF", "FOR", "TO", "DO", "END_FOR", "WHILE", "END_WHILE", "AND", "OR", "NOT", "TRUE",
    "FALSE", "ABS", "EXP", "EXPT", "MIN", "MAX", "SEL", "REAL_TO_LREAL", "LREAL_TO_REAL", "LREAL_TO_DINT",
}  # fmt: skip
DEFAULTS: dict[str, Callable[[], Any]] = {"LREAL": float, "DINT": int, "BOOL": bool, "STRING": str}


def expression(text: str) -> str:
    text = re.sub(r"(?<![:<>])=", "==", text).replace("<>", "!=")
    for word, python in {"AND": "and", "OR": "or", "NOT": "not", "TRUE": "True", "FALSE": "False"}.items():
        text = re.sub(rf"\b{word}\b", python, text)
    return text


def sel(chosen: bool, no: float, yes: float) -> float:
    return yes if chosen else no


class Block:
    """One function block: its declarations, and its body as Python."""

    def __init__(self, text: str) -> None:
        text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.S)
        head, _, rest = text.partition("FUNCTION_BLOCK ")
        assert not head.strip()
        self.body = rest[rest.rindex("END_VAR") + 7 : rest.index("END_FUNCTION_BLOCK")]
        self.values: dict[str, Any] = {}
        self.declared: Counter[str] = Counter()
        for section in re.findall(r"VAR\w*(?: CONSTANT)?\n(.*?)END_VAR", rest, re.S):
            for name, array, kind, value in re.findall(
                r"(\w+) : (?:ARRAY\[0\.\.(\d+)\] OF )?(\w+)(?:\[\d+\])?(?: := ([^;]*))?;", section
            ):
                self.declared[name] += 1
                if value:
                    self.values[name] = eval(expression(value))
                elif array:
                    self.values[name] = [DEFAULTS[kind]() for _ in range(int(array) + 1)]
                else:
                    self.values[name] = DEFAULTS[kind]()
                if array:
                    assert len(self.values[name]) == int(array) + 1
        self.code = compile(self._python(), "st", "exec")
        single = {"REAL_TO_LREAL": float, "LREAL_TO_REAL": lambda x: float(np.float32(x)), "LREAL_TO_DINT": round}
        self.space = {"ABS": abs, "EXP": exp, "EXPT": pow, "MIN": min, "MAX": max, "SEL": sel, **single, **self.values}

    def _python(self) -> str:
        out, depth = [], 0
        for line in filter(None, (line.strip() for line in self.body.splitlines())):
            if re.fullmatch(r"END_(IF|FOR|WHILE);", line):
                depth -= 1
                continue
            if line == "ELSE":
                out.append("    " * (depth - 1) + "else:")
                continue
            if found := re.fullmatch(r"IF (.*) THEN", line):
                text, deeper = f"if {expression(found[1])}:", 1
            elif found := re.fullmatch(r"FOR (\w+) := (.*) TO (.*) DO", line):
                text, deeper = f"for {found[1]} in range({found[2]}, {found[3]} + 1):", 1
            elif found := re.fullmatch(r"WHILE (.*) DO", line):
                text, deeper = f"while {expression(found[1])}:", 1
            else:
                found = re.fullmatch(r"([\w\[\]+* ]+) := (.*);", line)
                assert found, line
                value = found[2] if found[2].startswith("'") else expression(found[2])
                text, deeper = f"{found[1]} = {value}", 0
            out.append("    " * depth + text)
            depth += deeper
        assert depth == 0
        return "\n".join(out)

    def call(self, **inputs: Any) -> dict[str, Any]:
        self.space.update(inputs)
        exec(self.code, self.space)
        return self.space


def block_of(axis: ExportedAxis) -> Block:
    (text,) = StructuredTextExport().files(export_of(axis)).values()
    assert isinstance(text, str)
    return Block(text)


def errors(axis: ExportedAxis, rows: np.ndarray) -> np.ndarray:
    block, out = block_of(axis), []
    for row in rows:
        given = {f"in_{c}": v for c, v in zip(axis.program.channels, row.tolist(), strict=True)}
        done = block.call(elapsed_s=axis.program.step_s, reset=False, **given)
        out.append([done[o] if done["valid"] else np.nan for o in axis.output_units])
    return np.array(out)


def fits(key: str, axis: ExportedAxis) -> bool:
    return StructuredTextExport().refusal(export_of(axis)) is None


@pytest.mark.parametrize("key", PROGRAMS)
def test_a_family_computes_what_its_program_does_or_is_too_large(
    key: str, toy_batches: Batches, tmp_path: Path
) -> None:
    program, rows = fitted(key, toy_batches)
    axis = ExportedAxis("z", program, {}, LIMITS)
    if not fits(key, axis):
        with pytest.raises(InputError, match=r"^export st: axis z has \d+ constants, most in \w+; a block holds 2000"):
            EXPORTS["st"]().write(export_of(axis), tmp_path)
        return
    assert np.abs(errors(axis, rows) - replay(program, rows)).max() < 1e-9


def test_every_operation_with_holes() -> None:
    rows = rows_with_holes(every_operation())
    axis = ExportedAxis("z", every_operation(), {}, LIMITS)
    assert np.allclose(errors(axis, rows), replay(axis.program, rows), rtol=0.0, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("key", [*PROGRAMS, "every", "straight"])
def test_declarations_blocks_and_characters(key: str, toy_batches: Batches) -> None:
    axis = {"every": dynamic(), "straight": straight()}.get(key) or ExportedAxis(
        "z", fitted(key, toy_batches)[0], {}, LIMITS
    )
    (text,) = StructuredTextExport().files(export_of(axis)).values()
    assert isinstance(text, str) and text.isascii()
    assert max(map(len, text.splitlines())) < 200
    bare = re.sub(r"\(\*.*?\*\)", "", text, flags=re.S)
    for word in ("IF", "FOR", "WHILE", "FUNCTION_BLOCK", "VAR"):
        opened = len(re.findall(rf"(?<!END_)\b{word}(?:_INPUT|_OUTPUT)?\b", bare))
        assert opened == len(re.findall(rf"\bEND_{word}\b", bare)), word
    block = Block(text)
    assert max(block.declared.values()) == 1
    body = re.sub(r"'[^']*'|\b\d+\.\d+(E-?\d+)?\b", "", block.body)
    used = set(re.findall(r"\b[A-Za-z_]\w*", body)) - WORDS
    assert used == set(block.declared)


def test_the_correction_keeps_its_limits_holds_and_fades() -> None:
    block, good = block_of(offset_only()), {"in_t0": 20.0, "in_t1": 20.0}
    sent = [block.call(elapsed_s=300.0, reset=False, **good)["offset_um"] for _ in range(10)]
    assert sent[0] == 6.0 and sent[-1] == 38.5
    bad = good | {"in_t1": float("nan")}
    held = [block.call(elapsed_s=300.0, reset=False, **bad)["offset_um"] for _ in range(6)]
    assert held[:4] == [38.5] * 4 and held[4:] == pytest.approx([32.5, 26.5])
    back = block.call(elapsed_s=300.0, reset=False, ok_t1=True, **good)
    assert back["offset_um"] == pytest.approx(32.5) and back["valid"]
    assert not block.call(elapsed_s=300.0, reset=False, ok_t1=False, **good)["valid"]
    assert block.call(elapsed_s=0.0, reset=True, ok_t1=True, **good)["offset_um"] == pytest.approx(32.5)
    stopped = [block.call(elapsed_s=300.0, reset=False, enable=False, **good)["offset_um"] for _ in range(7)]
    assert stopped[:2] == pytest.approx([26.5, 20.5]) and stopped[-1] == 0.0


def test_short_cycles_run_the_model_at_its_step() -> None:
    block, seen = block_of(offset_only()), []
    for k in range(1000):
        done = block.call(elapsed_s=1.0, reset=False, in_t0=20.0 + k / 100.0, in_t1=20.0)
        seen.append(done["error_um"])
    assert np.flatnonzero(np.diff(seen)).tolist() == [299, 599, 899]


def test_numbers_are_literals_with_a_point() -> None:
    assert [real(x) for x in (3.0, 1e-7, -2.5e300, 1e22)] == ["3.0", "1.0E-7", "-2.5E300", "1.0E22"]
