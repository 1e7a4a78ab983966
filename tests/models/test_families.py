"""Every registered family keeps the contract, refuses bad options, and predicts without what it learned with."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data.errors import InputError
from features.design import Design
from models import FAMILIES
from thermodrift.testing import ContractCheck, check_family, runs


@pytest.mark.parametrize("check", [c for key in FAMILIES for c in check_family(key, generate_only=True)], ids=str)
def test_contract(check: ContractCheck) -> None:
    check()


def test_keys_are_those_of_the_registry() -> None:
    assert {key: family.key for key, family in FAMILIES.items()} == {key: key for key in FAMILIES}


@pytest.mark.parametrize(("key", "options", "words"), [
    ("bp", {"transfer": "tan"}, r"^family bp: unknown transfer 'tan': did you mean 'tanh'\? Allowed: linear, tanh$"),
    ("distributed_lag", {"lags": "almond"}, "unknown lags 'almond': did you mean 'almon'"),
    ("distributed_lag", {"order_by": "bix"}, "unknown order_by 'bix': did you mean 'bic'"),
    ("distributed_lag", {"lag_min": 0}, "expected lag_min above 0"),
    ("elastic_net", {"mixings": ()}, "expected mixings above 0 and at most 1"),
    ("elastic_net", {"mixings": (0.0,)}, "expected mixings above 0 and at most 1"),
    ("elastic_net", {"least": 0}, "expected mixings above 0 and at most 1"),
    ("elastic_net", {"n_penalties": 0}, "expected mixings above 0 and at most 1"),
    ("gm1n", {"response": "whitenin"}, "did you mean 'whitening'"),
    ("gm_dl", {"banded": "bath"}, "unknown banded 'bath': did you mean 'both'"),
    ("gm_dl", {"bands": 0}, "bands 0, least_batches 4; expected at least 1"),
    ("gm_dl", {"lags": "fee"}, "unknown lags 'fee': did you mean 'free'"),
    ("gm_dl", {"response": "white"}, "unknown response 'white'"),
    ("gm_lssvm", {"lengths_in": "mins"}, "unknown lengths_in 'mins': did you mean 'min'"),
    ("gm_lssvm", {"lengths": ()}, "expected at least one, above 0 rows"),
    ("gm_lssvm", {"tuning": "swarm"}, "unknown tuning 'swarm'"),
    ("huber", {"epsilons": ()}, "expected epsilons above 1"),
    ("huber", {"epsilons": (1.0,)}, "expected epsilons above 1"),
    ("huber", {"ridge": 0.0}, "expected epsilons above 1"),
    ("lssvm", {"tuning": "swarm"}, "lssvm: unknown tuning 'swarm'"),
    ("pcr", {"contribution": 1.2}, "pcr: contribution 1.2; expected above 0 and at most 1"),
    ("pls", {"max_components": 0}, "pls: max_components 0; expected at least 1"),
    ("ridge", {"least": 0.0}, "expected 0 < least <= most"),
    ("svr", {"max_rows": 1}, r"svr: max_rows 1,.* expected at least 2 rows and values above 0"),
])  # fmt: skip
def test_impossible_options_are_told(key: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        FAMILIES[key](**options)


@pytest.mark.parametrize(("key", "need"), [("bp", 2), ("lssvm", 2), ("svr", 2), ("lag_dictionary", 4)])
def test_too_few_rows_are_told_with_the_batches_and_what_is_needed(key: str, need: int) -> None:
    design = runs.design(False)
    batch_ids = design.batch_ids
    empty = Design(design.inputs, "z", batch_ids, design.x, np.full(len(design.x), np.nan), design.time_s,
                   design.offsets, design.step_s)  # fmt: skip
    words = f"^family {key}: got 0 usable rows of z in {batch_ids[1]}, {batch_ids[2]}, need at least {need}; give"
    with pytest.raises(InputError, match=words):
        FAMILIES[key]().as_published().fit_design(empty, [1, 2])


def test_a_trained_model_predicts_without_what_trains_it(tmp_path: Path) -> None:
    design = runs.design(False)
    models = [FAMILIES[key]().fit_design(design, [0, 1]) for key in ("bp", "gru", "svr")]
    given = {"x": design.x[design.rows(2)].tolist(), "plain": [model.as_plain() for model in models]}
    path = tmp_path / "models.json"
    path.write_text(json.dumps(given, default=lambda array: {"array": array.tolist()}), encoding="utf-8")
    code = (
        "import json, sys, numpy as np; from models.base import family_from_plain; from features.design import Design\n"
        "array = lambda part: np.array(part['array']) if 'array' in part else part\n"
        "given = json.load(open(sys.argv[1]), object_hook=array); x = np.array(given['x']); n = len(x)\n"
        f"design = Design({design.inputs}, '', ('a',), x, x[:, 0], np.arange(n) * 300.0, np.array([0, n]), 300.0)\n"
        "for plain in given['plain']: print(float(family_from_plain(plain).predict_design(design, [0])[0][-1]))\n"
        "print('torch' in sys.modules, 'sklearn' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    *told, imported = done.stdout.splitlines()
    want = [model.predict_design(design, [2])[0][-1] for model in models]
    np.testing.assert_allclose([float(value) for value in told], want, rtol=1e-12)
    assert imported == "False False"
