"""The published studies that `thermodrift reproduce` repeats, one line each."""

from data.registry import Registry

STUDIES = Registry(
    "study",
    {
        "year_round_pcr": "evidence.studies.year_round_pcr:YearRoundPCR",
        "grey_lssvm": "evidence.studies.grey_lssvm:GreyLSSVM",
        "coupled_lathe": "evidence.studies.coupled_lathe:CoupledLathe",
        "main_factor": "evidence.studies.main_factor:MainFactor",
        "grey_distributed_lag": "evidence.studies.grey_distributed_lag:GreyDistributedLag",
    },
)
