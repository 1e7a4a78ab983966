"""What a machine does over time, from stages or a table."""

from twin.run_plan.plan import RunPlan, load_run_plan

__all__ = ["RunPlan", "load_run_plan"]
