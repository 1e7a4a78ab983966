"""The files by which a stored model is served where thermodrift is not installed, see
`pipelines.store.pyfunc_model`."""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path

import numpy as np

from compensation.exports.base import Export, ExportedAxis
from compensation.exports.onnx_graph import OnnxExport
from compensation.safety import Limits
from data.errors import InputError
from models.program import Program
from pipelines.store.model_store import SERVED, StoredModel, add_hashes


def write_served(stored: StoredModel, folder: Path, step_s: float) -> tuple[str, ...]:
    """Writes the ONNX files of a model and of its trained region next to it, and their hashes into its `model.json`;
    the names of the files, none where the family is no program or the step is not known."""
    channels = stored.machine.batch_channels()
    try:
        model = stored.family.program(channels, step_s)
    except InputError:
        return ()
    region = stored.region.program(channels, step_s)
    made = OnnxExport()
    for name, program in (("model.onnx", model), ("region.onnx", region)):
        files = made.files(_export(stored, program, (folder / "model.json").read_bytes()))
        (whole,) = (content for path, content in files.items() if path.endswith("_batch.onnx"))
        (folder / name).write_bytes(whole if isinstance(whole, bytes) else whole.encode())
    low, high, width = stored.region.widths()
    pattern = stored.region.pattern()
    stated = {
        "schema": "thermodrift.serving/1", "step_s": step_s, "channels": list(model.channels),
        "required": list(stored.channels()), "watched": list(region.channels), "simulated": stored.simulated,
        "region": {
            "names": list(stored.region.ranges), "low": low.tolist(), "high": high.tolist(), "width": width.tolist(),
            **{k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in pattern.items()},
        },
    }  # fmt: skip
    (folder / "serving.json").write_text(json.dumps(stated, indent=1), encoding="utf-8")
    add_hashes(folder, SERVED)
    return SERVED


def _export(stored: StoredModel, program: Program, content: bytes) -> Export:
    axis = ExportedAxis(stored.family.target, program, {}, Limits())
    return Export(
        machine=stored.machine.machine, model=stored.family.key, version=str(stored.info.get("training_id", "")),
        digest=hashlib.sha256(content).hexdigest(), created=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        simulated=stored.simulated, axes=(axis,),
    )  # fmt: skip
