"""The published studies that `thermodrift reproduce` repeats, one line each."""

from data.registry import Registry

STUDIES = Registry(
    "study",
    {
        "year_round_pcr": "models.studies.year_round_pcr:YearRoundPCR",
        "grey_lssvm": "models.studies.grey_lssvm:GreyLSSVM",
        "coupled_lathe": "models.studies.coupled_lathe:CoupledLathe",
        "main_factor": "models.studies.main_factor:MainFactor",
        "grey_distributed_lag": "models.studies.grey_distributed_lag:GreyDistributedLag",
    },
)
