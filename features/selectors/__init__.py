"""Registry of selectors."""

from data.registry import Registry

SELECTORS = Registry(
    "selector",
    {
        "none": "features.selectors.none:NoSelection",
        "correlation": "features.selectors.correlation:Correlation",
        "pca_elimination": "features.selectors.pca_elimination:PcaElimination",
        "fcgc": "features.selectors.fcgc:FuzzyClusterGreyCorrelation",
        "fuzzy_correlation": "features.selectors.fuzzy_correlation:FuzzyCorrelation",
        "main_factor_bp": "features.selectors.main_factor_bp:MainFactorBP",
        "fcm_grey": "features.selectors.fcm_grey:FcmGrey",
        "mrmr": "features.selectors.mrmr:MRMR",
        "elastic_net_path": "features.selectors.elastic_net_path:ElasticNetPath",
        "vif_pruning": "features.selectors.vif_pruning:VifPruning",
        "kmedoids": "features.selectors.kmedoids:KMedoids",
        "sequential_forward": "features.selectors.sequential_forward:SequentialForward",
        "exhaustive": "features.selectors.exhaustive:Exhaustive",
    },
)
