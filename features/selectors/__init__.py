"""The selectors, one line each."""

from data.registry import Registry

SELECTORS = Registry(
    "selector",
    {
        "none": "features.selectors.none:NoSelection",
        "correlation": "features.selectors.correlation:Correlation",
        "pca_elimination": "features.selectors.pca_elimination:PcaElimination",
        "fcgc": "features.selectors.fcgc:FuzzyClusterGreyCorrelation",
        "fuzzy_correlation": "features.selectors.fuzzy_correlation:FuzzyCorrelation",
    },
)
