"""What of a case could give its answer away without physics: names, sizes, gaps, inputs, the machine file's text."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

RARE = 0.03  # of the cases; a word of the machine file that stands in fewer, or lacks in fewer, tells nothing
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?$", re.IGNORECASE)


def leak_features(cases: Sequence[Path]) -> pd.DataFrame:
    """A row a case folder, a column a feature; nothing of what sensors and probes show. Unknown values are nan."""
    texts = [(folder / "machine.yml").read_text(encoding="utf-8") for folder in cases]
    described = [_described(text, folder / "recordings") for text, folder in zip(texts, cases, strict=True)]
    words = pd.DataFrame([_words(text) for text in texts]).notna()
    held = words.mean()
    words = words.loc[:, (held > RARE) & (held < 1 - RARE)].astype(float).add_prefix("word ")
    return pd.concat([pd.DataFrame(described), words], axis=1).astype(float)


def _described(text: str, recordings: Path) -> dict[str, float]:
    tree: Mapping[str, Any] = yaml.load(text, yaml.CSafeLoader)
    role = {name: str(given.get("role")) for name, given in tree["channels"].items()}
    return _machine(text, tree, list(role.values())) | _recordings(recordings, role)


def _machine(text: str, tree: Mapping[str, Any], roles: Sequence[str]) -> dict[str, float]:
    """Sizes of the file and of its parts, and how its numbers look."""
    twin = tree.get("twin") or {}
    name = str(tree["machine"])
    out: dict[str, float] = {
        "file characters": len(text),
        "file lines": text.count("\n"),
        "machine name length": len(name),
    }
    out |= {f"machine name {k}": ord(c) for k, c in enumerate(name[:8])}
    out |= {f"{role} channels": roles.count(role) for role in ("temperature", "ambient", "driver", "error")}
    out |= {f"{part} in the file": len(given) for part, given in sorted(twin.items()) if isinstance(given, Mapping)}
    errors = (twin.get("errors") or {}).values()
    out |= {kind: sum(len(e.get(kind) or ()) for e in errors) for kind in ("chain", "tilts")}
    for part, given in sorted(twin.items()):
        values = np.array([v for key, v in _numbers(given) if key == "value"])
        spreads = np.array([v for key, v in _numbers(given) if key == "spread"])
        size = np.log(np.abs(values[values != 0]))
        out |= {f"{part} value mean": _mean(size), f"{part} value sd": _sd(size)}
        out |= {f"{part} spread mean": _mean(spreads), f"{part} spread sd": _sd(spreads)}
    return {k: float(v) for k, v in out.items()}


def _words(text: str) -> dict[str, bool]:
    """Every key and every word of the file that is no number."""
    return {word: True for word in re.findall(r"[A-Za-z_][\w-]*", text) if len(word) > 1}


def _numbers(tree: Any, key: str = "") -> list[tuple[str, float]]:
    """Numbers of a part of the file with the key that they stand at; of "12.5 W/K" the number."""
    if isinstance(tree, Mapping):
        return [found for k, v in tree.items() for found in _numbers(v, str(k))]
    if isinstance(tree, list):
        return [found for v in tree for found in _numbers(v, key)]
    first = str(tree).partition(" ")[0]
    return [(key, float(first))] if NUMBER.match(first) else []


def _recordings(folder: Path, role: Mapping[str, str]) -> dict[str, float]:
    """Rows, holes, clocks, drivers and surroundings of the recordings: means over them, and how they scatter."""
    rows = pd.DataFrame([_recording(path, role) for path in sorted(folder.iterdir())])
    out = {f"{c}, mean": _mean(rows[c].dropna()) for c in rows} | {f"{c}, sd": _sd(rows[c].dropna()) for c in rows}
    return out | {"recordings": float(len(rows))}


def _recording(path: Path, role: Mapping[str, str]) -> dict[str, float]:
    table = pd.read_csv(path, comment="#")
    clock = table["time_s"].to_numpy(float)
    steps = np.diff(clock)
    digits = [int(d) for d in re.findall(r"\d", path.stem)]
    out: dict[str, float] = {
        "bytes": path.stat().st_size, "rows": len(table), "columns": len(table.columns), "name length": len(path.stem),
        "first row": clock[0], "step": float(np.median(steps)), "step sd": float(np.std(steps)),
        "longest step": float(steps.max()), "end": clock[-1],
    }  # fmt: skip
    out |= {f"name digit {k}": float(d) for k, d in enumerate(digits[:14])}
    for kind in ("temperature", "ambient", "driver", "error"):
        own = table[[c for c in table.columns if role.get(str(c)) == kind]]
        out[f"{kind} columns"] = len(own.columns)
        out[f"{kind} cells empty"] = float(own.isna().to_numpy().mean()) if own.size else 0.0
        if kind in ("ambient", "driver"):
            for name in own:
                out |= _input(str(name), own[name].dropna().to_numpy(float))
    return out


def _input(name: str, values: np.ndarray) -> dict[str, float]:
    if not len(values):
        return {}
    changes = np.diff(values)
    return {
        f"{name} level": float(values.mean()), f"{name} scatter": float(values.std()),
        f"{name} top": float(values.max()), f"{name} on": float((values > 0).mean()),
        f"{name} changes": float((changes != 0).mean()), f"{name} drift": float(values[-1] - values[0]),
    }  # fmt: skip


def _mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _sd(values: Any) -> float:
    return float(np.std(values)) if len(values) else float("nan")
