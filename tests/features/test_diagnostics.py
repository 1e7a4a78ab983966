"""Known weaknesses, planted: each diagnostic must see its own and stay quiet without it."""

import numpy as np
import pytest
from stacked_rows import LENGTHS, chain, orthonormal, stack, year

from data.errors import InputError
from features.selectors import SELECTORS
from features.stability import stability_over_batches

TRAIN = [0, 1, 3]
N = sum(LENGTHS)


@pytest.mark.parametrize("key", ["fcgc", "fuzzy_correlation"])
def test_chaining_is_seen(key: str) -> None:
    everything = range(len(LENGTHS))
    gap, share = SELECTORS[key]().diagnostics(chain(), everything, 2)
    # t0 … t4 hang together over t2 at √0.8; the farthest members have t1's and t3's own |corr|, 0.6 / 1.04
    assert gap.value == pytest.approx(np.sqrt(0.8) - 0.6 / 1.04, abs=1e-6) and not gap.ok
    assert "t1 and t3 share a cluster of level 0.89; their own |corr| is 0.58" in gap.comment
    assert share.value == pytest.approx(5 / 6) and not share.ok and share.comment == "5 of 6 inputs; 2 clusters in all"


@pytest.mark.parametrize("key", ["fcgc", "fuzzy_correlation"])
def test_well_kept_apart_groups_raise_nothing(key: str) -> None:
    q = orthonormal(N, 6, seed=3)
    x = np.column_stack([q[:, i % 2] + 0.05 * q[:, 2 + i] for i in range(4)])
    gap, share = SELECTORS[key]().diagnostics(stack(x, q[:, 0], LENGTHS), range(5), 2)
    assert gap.ok and gap.value == pytest.approx(0.0, abs=1e-9) and share.ok and share.value == 0.5
    assert (
        SELECTORS[key]().diagnostics(chain(), range(5), 1) == () == SELECTORS[key]().diagnostics(chain(), range(5), 6)
    )


def test_tied_eigenvalues_are_seen() -> None:
    r = np.zeros((5, 5))
    r[:3, :3], r[3:, 3:] = 0.8, 0.99  # eigenvalues 2.6 .2 .2 and 1.99 .01: the second step is tied
    np.fill_diagonal(r, 1.0)
    design = stack(orthonormal(N, 5, seed=6) @ np.linalg.cholesky(r).T, np.arange(N) % 7.0, LENGTHS)
    (four,) = SELECTORS["pca_elimination"]().diagnostics(design, range(5), 4)
    assert four.ok and four.value == pytest.approx(1 - 0.01 / 0.2)
    (three,) = SELECTORS["pca_elimination"]().diagnostics(design, range(5), 3)
    assert not three.ok and three.value == pytest.approx(0.0, abs=1e-9) and "t2 was dropped" in three.comment
    assert SELECTORS["pca_elimination"]().diagnostics(design, range(5), 5) == ()


def test_near_twins_among_the_chosen_are_named() -> None:
    design = stack(*year(), LENGTHS)
    x, y, _ = design.stacked(TRAIN)
    r = np.abs(np.corrcoef(np.column_stack([x, y]), rowvar=False))
    for n in (2, 4):
        chosen = np.sort(np.argsort(-r[-1, :-1])[:n])
        i, j = max(((a, b) for a in chosen for b in chosen if a < b), key=lambda pair: r[pair])
        (d,) = SELECTORS["correlation"]().diagnostics(design, TRAIN, n)
        assert d.value == pytest.approx(r[i, j]) and d.ok == (r[i, j] <= 0.95)
        assert d.comment.startswith(f"t{i} and t{j} are")
    assert SELECTORS["correlation"]().diagnostics(design, TRAIN, 1) == ()


def test_stability_names_the_points_that_come_and_go() -> None:
    always = stability_over_batches([("a", "b")] * 4)
    assert always.ok and always.value == 1.0 and always.comment == "the same points whichever batch is left out"
    torn = stability_over_batches([("a", "b"), ("a", "c"), ("a", "b"), ("a", "d")])
    # pairs: b b is 1, the five others 1/3
    assert torn.value == pytest.approx((1 + 5 / 3) / 6) and not torn.ok and torn.threshold == 0.7
    assert torn.comment == "not in every fold: b 50 %, c 25 %, d 25 %"
    with pytest.raises(InputError, match="got no set; expected one per fold"):
        stability_over_batches([])
