"""A twin as a stored model, and what the report calls the families."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml

from data.errors import InputError
from models import FAMILIES
from models.trust import Region
from models.twin import Twin
from models.twin_kalman import TwinKalman
from pipelines import model_store
from reports.labels import family_label, styles
from tests.models.twin_year import year


@pytest.mark.parametrize("family", [Twin(), TwinKalman()])
def test_a_stored_twin_predicts_the_same_and_says_what_it_needs(family, tmp_path):
    machine, batches = year(3)
    model = family.fit(batches[:2], ["t_head"], "z", machine)
    text = yaml.safe_dump(json.loads(machine.model_dump_json(exclude_none=True)), sort_keys=False)
    model_store.save(tmp_path, model, text, Region.of([], ()))
    back = model_store.load(tmp_path)
    np.testing.assert_array_equal(back.predict(batches[2]), model.predict(batches[2]))
    assert {"rpm", "room"} <= set(back.channels())
    silent = batches[2].table.assign(rpm=np.nan)
    with pytest.raises(InputError, match=r"needs 'rpm' .*, which the recording does not have"):
        model_store.predict_frame(back, silent)


def test_every_family_has_a_name_and_a_style_of_its_own():
    assert [family_label(k) for k in ("twin", "twin_residual", "twin_kalman")] == [
        "physics twin", "twin + residual", "twin with sensors",
    ]  # fmt: skip
    looks = styles(list(FAMILIES))
    assert len(set(looks.values())) == len(FAMILIES)
    assert len({color for color, _ in list(looks.values())[:8]}) == 8
