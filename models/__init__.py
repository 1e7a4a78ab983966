"""Registry of model families, and what they reached on other machines."""

from collections.abc import Mapping

from data.registry import Registry

FAMILIES = Registry(
    "family",
    {
        "zero": "models.families.baselines:Zero",
        "mean_curve": "models.families.baselines:MeanCurve",
        "thermal_exponential": "models.families.thermal_exponential:ThermalExponential",
        "twin": "models.families.twin:Twin",
        "twin_residual": "models.families.twin_residual:TwinResidual",
        "twin_kalman": "models.families.twin_kalman:TwinKalman",
        "mlr": "models.families.mlr:MLR",
        "ridge": "models.families.ridge:Ridge",
        "pcr": "models.families.pcr:PCR",
        "pcr_lbo": "models.families.pcr:PCRByLeaveBatchOut",
        "pls": "models.families.pls:PLS",
        "elastic_net": "models.families.elastic_net:ElasticNet",
        "huber": "models.families.huber:Huber",
        "distributed_lag": "models.families.distributed_lag:DistributedLag",
        "lag_dictionary": "models.families.lag_dictionary:LagDictionary",
        "axis_coupled": "models.families.axis_coupled:AxisCoupled",
        "bp": "models.families.bp:BP",
        "bp_linear": "models.families.bp:BPLinear",
        "lstm": "models.families.recurrent:LSTM",
        "gru": "models.families.recurrent:GRU",
        "tcn": "models.families.tcn:TCN",
        "lssvm": "models.families.lssvm:LSSVM",
        "svr": "models.families.svr:SVR",
        "gm1n": "models.families.gm1n:GM1N",
        "transfer_function": "models.families.transfer_function:TransferFunction",
        "gm_lssvm": "models.families.gm_lssvm:GMLSSVM",
        "gaussian_process": "models.families.gaussian_process:GaussianProcess",
        "random_forest": "models.families.random_forest:RandomForest",
        "hist_gradient_boosting": "models.families.hist_gradient_boosting:HistGradientBoosting",
        "gm_dl": "models.families.gm_dl:GMDL",
        "stack": "models.selection.stack:Stack",
    },
)

# Mean S of later runs with all points over that of the best family, geometric mean over four kinds of machine: the
# sample year (3 + 2 error channels of two seeds), simulated machines of two kinds (3 + 2 each), the spindle (3); see
# `python -m benchmarks.forward --records`. It counts like so many runs of the machine at hand
# (`PromotionRule.record_runs`); a family without a record gets the usual one.
RECORDS: Mapping[str, float] = {
    "lag_dictionary": 1.09, "stack": 1.16, "distributed_lag": 1.38, "twin_residual": 1.45, "transfer_function": 1.46,
    "gru": 1.47, "lstm": 1.47, "tcn": 1.47, "gaussian_process": 1.53, "ridge": 1.54, "pcr_lbo": 1.56, "lssvm": 1.57,
    "pls": 1.58, "bp_linear": 1.60, "elastic_net": 1.60, "huber": 1.62, "svr": 1.65, "mlr": 1.65, "bp": 1.68,
    "gm_dl": 2.13, "hist_gradient_boosting": 2.15, "random_forest": 2.25, "gm_lssvm": 2.31, "twin": 2.45,
    "thermal_exponential": 2.62, "pcr": 2.65, "mean_curve": 3.75, "gm1n": 4.15, "zero": 6.00,
}  # fmt: skip
USUAL_RECORD = 1.6
