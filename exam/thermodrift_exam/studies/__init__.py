"""The published studies that `thermodrift reproduce` repeats, one line each."""

from data.registry import Registry

STUDIES = Registry(
    "study",
    {
        "year_round_pcr": "thermodrift_exam.studies.year_round_pcr:YearRoundPCR",
        "grey_lssvm": "thermodrift_exam.studies.grey_lssvm:GreyLSSVM",
        "coupled_lathe": "thermodrift_exam.studies.coupled_lathe:CoupledLathe",
        "main_factor": "thermodrift_exam.studies.main_factor:MainFactor",
        "grey_distributed_lag": "thermodrift_exam.studies.grey_distributed_lag:GreyDistributedLag",
    },
)
