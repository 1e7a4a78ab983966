"""Registry of model families."""

from data.registry import Registry

FAMILIES = Registry(
    "family",
    {
        "zero": "models.baselines:Zero",
        "mean_curve": "models.baselines:MeanCurve",
        "thermal_exponential": "models.thermal_exponential:ThermalExponential",
        "twin": "models.twin:Twin",
        "twin_residual": "models.twin_residual:TwinResidual",
        "twin_kalman": "models.twin_kalman:TwinKalman",
        "mlr": "models.mlr:MLR",
        "ridge": "models.ridge:Ridge",
        "pcr": "models.pcr:PCR",
        "pcr_lbo": "models.pcr:PCRByLeaveBatchOut",
        "pls": "models.pls:PLS",
        "elastic_net": "models.elastic_net:ElasticNet",
        "huber": "models.huber:Huber",
        "distributed_lag": "models.distributed_lag:DistributedLag",
        "lag_dictionary": "models.lag_dictionary:LagDictionary",
        "axis_coupled": "models.axis_coupled:AxisCoupled",
        "bp": "models.bp:BP",
        "bp_linear": "models.bp:BPLinear",
        "lstm": "models.recurrent:LSTM",
        "gru": "models.recurrent:GRU",
        "tcn": "models.tcn:TCN",
        "lssvm": "models.lssvm:LSSVM",
        "svr": "models.svr:SVR",
        "gm1n": "models.gm1n:GM1N",
        "transfer_function": "models.transfer_function:TransferFunction",
        "gm_lssvm": "models.gm_lssvm:GMLSSVM",
        "gaussian_process": "models.gaussian_process:GaussianProcess",
        "random_forest": "models.random_forest:RandomForest",
        "hist_gradient_boosting": "models.hist_gradient_boosting:HistGradientBoosting",
        "gm_dl": "models.gm_dl:GMDL",
    },
)
