"""Rivals by key. A new one: a function in a file of its own and a line here.

A baseline is called with the search, an ablation with its `Stage`; both return a `Reply`.
"""

from data.registry import Registry

BASELINES = Registry(
    "baseline",
    {
        "raw_correlation": "twin.proof.rivals.raw_correlation:raw_correlation",
        "sparse_regression": "twin.proof.rivals.sparse_regression:sparse_regression",
        "in_sample_bic": "twin.proof.rivals.in_sample_bic:in_sample_bic",
    },
)
ABLATIONS = Registry(
    "ablation",
    {
        "reference": "twin.proof.rivals.ablations:reference",
        "no_projection": "twin.proof.rivals.ablations:no_projection",
        "independent_noise": "twin.proof.rivals.ablations:independent_noise",
        "in_sample": "twin.proof.rivals.ablations:in_sample",
        "no_structural_null": "twin.proof.rivals.ablations:no_structural_null",
        "no_floor_check": "twin.proof.rivals.ablations:no_floor_check",
    },
)
