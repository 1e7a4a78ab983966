"""Rules that several families share."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data.errors import InputError
from features.design import Design
from models.families import FAMILIES
from tests.toys import runs


@pytest.mark.parametrize(("key", "options", "words"), [
    ("pcr", {"contribution": 1.2}, "pcr: contribution 1.2; expected above 0 and at most 1"),
    ("pls", {"max_components": 0}, "pls: max_components 0; expected at least 1"),
    ("ridge", {"least": 0.0}, "expected 0 < least <= most"),
    ("elastic_net", {"mixings": ()}, "expected mixings above 0 and at most 1"),
    ("elastic_net", {"mixings": (0.0,)}, "expected mixings above 0 and at most 1"),
    ("elastic_net", {"least": 0}, "expected mixings above 0 and at most 1"),
    ("elastic_net", {"n_penalties": 0}, "expected mixings above 0 and at most 1"),
    ("huber", {"epsilons": ()}, "expected epsilons above 1"),
    ("huber", {"epsilons": (1.0,)}, "expected epsilons above 1"),
    ("huber", {"ridge": 0.0}, "expected epsilons above 1"),
    ("distributed_lag", {"lags": "almond"}, "unknown lags 'almond': did you mean 'almon'"),
    ("distributed_lag", {"order_by": "bix"}, "unknown order_by 'bix': did you mean 'bic'"),
    ("distributed_lag", {"lag_min": 0}, "expected lag_min above 0"),
    ("transfer_function", {"poles": 3}, "family transfer_function: poles is 3, expected 0, 1 or 2; choose one"),
    ("axis_coupled", {"max_terms": 1}, r"max_terms 1, worth 0.01; expected at least 2 terms and 0 <= worth < 1"),
    ("twin", {"start": "warm"}, "start is 'warm', expected 'usual' or 'settled'"),
    ("twin_residual", {"residual": "forest"}, "residual is 'forest', expected ridge or gp"),
    ("twin_kalman", {"residual": "gp"}, "residual is 'gp', expected ridge or none"),
    ("twin_kalman", {"heat_spread": -1}, "heat_spread is -1"),
    ("gm1n", {"response": "whitenin"}, "did you mean 'whitening'"),
    ("gm_dl", {"banded": "bath"}, "unknown banded 'bath': did you mean 'both'"),
    ("gm_dl", {"bands": 0}, "bands 0, least_batches 4; expected at least 1"),
    ("gm_dl", {"lags": "fee"}, "unknown lags 'fee': did you mean 'free'"),
    ("gm_dl", {"response": "white"}, "unknown response 'white'"),
    ("gm_lssvm", {"lengths_in": "mins"}, "unknown lengths_in 'mins': did you mean 'min'"),
    ("gm_lssvm", {"lengths": ()}, "expected at least one, above 0 rows"),
    ("gm_lssvm", {"tuning": "swarm"}, "unknown tuning 'swarm'"),
    ("lssvm", {"tuning": "swarm"}, "lssvm: unknown tuning 'swarm'"),
    ("svr", {"max_rows": 1}, r"svr: max_rows 1,.* expected at least 2 rows and values above 0"),
    ("bp", {"transfer": "tan"}, r"^family bp: unknown transfer 'tan': did you mean 'tanh'\? Allowed: linear, tanh$"),
    *((key, {"device": "tpu"}, f"^family {key}: device 'tpu'; expected one of auto, cpu, cuda$")
      for key in ("gru", "lstm", "tcn")),
    *((key, {"hidden": 0}, f"^family {key}: hidden: got 0, expected 1 or more$") for key in ("gru", "lstm", "tcn")),
])  # fmt: skip
def test_impossible_options_are_told(key: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        FAMILIES[key](**options)


@pytest.mark.parametrize(("key", "need"), [
    ("mlr", 4), ("ridge", 4), ("pcr", 4), ("pcr_lbo", 4), ("pls", 4), ("distributed_lag", 4), ("gaussian_process", 4),
    ("lag_dictionary", 4), ("gru", 4), ("lstm", 4), ("tcn", 4), ("transfer_function", 8), ("lssvm", 2), ("svr", 2),
    ("bp", 2),
])  # fmt: skip
def test_too_few_rows_are_told_in_one_line(key: str, need: int) -> None:
    design = by_hand()
    scarce = replace(design, y_um=np.where(np.isin(np.arange(len(design.x)), [runs.N]), design.y_um, np.nan))
    with pytest.raises(InputError) as error:
        FAMILIES[key]().fit_folds(scarce, [[1, 2]])
    assert str(error.value) == (
        f"family {key}: got 1 usable rows of z in b1, b2, need at least {need}; give more batches, drop inputs that "
        "are missing, or overrule a check in the machine file"
    )


@pytest.mark.parametrize(("key", "words"), [
    *((k, f"^{k}: no inputs given for z; name at least one") for k in ("mlr", "ridge", "pcr", "pcr_lbo", "pls")),
    ("lag_dictionary", "^lag_dictionary: no inputs given for z; name a channel$"),
    ("transfer_function", "got 0 inputs for z, expected 1 to 60; let a selector choose"),
])  # fmt: skip
def test_without_inputs_a_channel_or_a_selector_is_asked_for(key: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        FAMILIES[key]().fit_folds(runs.design(False).subset(()), [[0]])


def by_hand() -> Design:
    """The suite's five runs as rows alone."""
    made = runs.design(False)
    return Design(made.inputs, "z", tuple(f"b{k}" for k in range(5)), made.x, made.y_um, made.time_s, made.offsets,
                  made.step_s, input_units=made.input_units)  # fmt: skip


@pytest.mark.parametrize(("key", "options"), [
    *((key, {}) for key in (
        "mlr", "ridge", "pcr", "pcr_lbo", "pls", "bp", "bp_linear", "gaussian_process", "lag_dictionary",
    )),
    ("transfer_function", {}), ("transfer_function", {"drivers": True}), ("lssvm", {}), ("lssvm", {"max_rows": 45}),
])  # fmt: skip
@pytest.mark.parametrize("form", ["default", "published"])
def test_all_folds_at_once_are_the_folds_one_by_one(key: str, options: dict[str, Any], form: str) -> None:
    """Folds that share work with others, and folds unlike all others, of runs of different lengths."""
    design, family = runs.design(False), FAMILIES[key](**options)
    family = family if form == "default" else family.as_published()
    short = (design.group == 1) & (np.arange(len(design.x)) >= design.offsets[2] - runs.N // 3)
    design = replace(design, y_um=np.where(short, np.nan, design.y_um))
    folds = [[1, 2, 3, 4], [0, 2, 3, 4], [0, 1, 2, 4], [0, 3], [2], [0, 1, 2, 3, 4]]
    together = family.fit_folds(design, folds)
    rows = family.predict_folds(design, together, [range(5)] * len(folds))
    for fold, model, own in zip(folds, together, rows, strict=True):
        alone = family.fit_design(design, fold)
        want = np.concatenate(alone.predict_design(design, range(5)))
        np.testing.assert_allclose(np.concatenate(model.predict_design(design, range(5))), want, atol=1e-6)
        np.testing.assert_allclose(np.concatenate(own), want, atol=1e-6)
        if family.has_sd:
            np.testing.assert_allclose(model.sd_um(design, [0])[0], alone.sd_um(design, [0])[0], rtol=1e-6)
    assert family.fit_folds(design, []) == []


@pytest.mark.integration
@pytest.mark.parametrize(("key", "library"), [("bp", "torch"), ("gru", "torch"), ("svr", "sklearn")])
def test_a_trained_model_predicts_without_the_library_that_it_learned_with(
    key: str, library: str, tmp_path: Path
) -> None:
    design = runs.design(False)
    model = FAMILIES[key]().fit_design(design, [0, 1])
    plain = json.dumps(model.as_plain(), default=lambda a: {"array": a.tolist(), "dtype": str(a.dtype)})
    (tmp_path / "model").write_text(plain)
    code = (
        "import json, sys; from pathlib import Path; import numpy as np; from models.base import family_from_plain; "
        "from tests.toys import runs; "
        "array = lambda part: np.array(part['array'], part['dtype']) if 'array' in part else part; "
        "plain = json.loads(Path(sys.argv[1]).read_text(), object_hook=array); "
        "error_um = family_from_plain(plain).predict_design(runs.design(False), [2])[0]; "
        "print(float(error_um[-1]), sys.argv[2] in sys.modules)"
    )
    call = [sys.executable, "-c", code, str(tmp_path / "model"), library]
    done = subprocess.run(call, capture_output=True, text=True)
    want = float(model.predict_design(design, [2])[0][-1])
    assert done.stdout.split() == [str(want), "False"], done.stderr
