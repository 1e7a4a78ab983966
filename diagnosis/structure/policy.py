"""Every number of the diagnosis under simulated structure that changes a decision, with unit, reason and evidence."""

from __future__ import annotations

from dataclasses import dataclass

from diagnosis.policy import analytic, convention, cost, physical


@dataclass(frozen=True)
class StructurePolicy:
    """Thresholds by stage, next to those that it shares with `diagnosis.policy.POLICY`; gains in nats of evidence."""

    # Refined twins
    refined_twins: int = cost(120, "machines", "refined twins that make the covariance; with 40 it knows too little")
    null_twins: int = cost(60, "machines", "refined twins of another style that it has not seen")
    refined_cells: tuple[int, int] = cost((3, 6), "cells", "of every lump of a refined twin")
    piece_evenness: float = convention(4.0, "Dirichlet parameter", "of the capacities of the pieces of a body")
    biot_ranges: tuple[tuple[float, float], ...] = physical(
        ((0.01, 0.1), (0.1, 1.0), (1.0, 20.0)), "Biot number", "stiff to soft: a solid block to a thin-walled casting"
    )
    biot_log_sd: float = physical(0.6, "log", "between the bodies of a machine")
    joint_log_sd: float = physical(0.3, "log", "between the conductances inside a body")

    # Mild physics that every machine has
    heat_shape_sd: float = physical(0.05, "of a heat", "no heat follows its driver exactly as its law says")
    clock_sd_rows: float = analytic(0.1, "rows", "a row is a mean over its interval, which blurs corners")
    common_clock_sd_rows: float = analytic(0.5, "rows", "a driver that is held may have changed between two rows")

    # Covariance
    block_min_variance: float = analytic(1e-3, "of the noise's", "a smaller variance of a block changes nothing")
    effective_log_sd: float = physical(1.0, "log", "a lump's effective value lies within a factor of e of the body's")
    effective_sd: float = physical(4.0, "prior sd", "the same of gains, shares and temperatures")
    reach: float = convention(3.0, "of that freedom", "no fit goes further")
    least_energy: float = analytic(0.03, "given variances", "of a direction of the covariance in all rows together")
    scales: tuple[float, ...] = convention(
        (0.05, 0.2, 0.4, 0.7, 1.0, 1.5, 2.2, 3.3, 5.0), "of the draws", "scales whose likelihood is compared"
    )
    scale_rounds: int = cost(2, "rounds", "over the groups of draws")

    # Fits
    first_steps: int = cost(12, "steps", "of plain least squares before any structure is known")
    settle_rounds: int = cost(3, "rounds", "of the covariance, built anew about the fit")
    settle_steps: int = cost(10, "steps", "of the last round of a fit")
    fair_rounds: int = cost(2, "rounds", "of a baseline that continues from where a refit has led")
    refit_steps: int = cost(2, "steps", "Gauss-Newton, of a refit")
    finalists: int = cost(6, "refits", "that are settled, each under a covariance of its own")
    short_refit_share: float = convention(0.5, "of the screen's gain", "a refit with less begins anew, nearer to none")
    dampings: tuple[float, ...] = analytic(
        (0.0, 1.0, 10.0, 100.0, 1e3, 1e4), "prior", "tried until the objective falls"
    )
    settled_nats: float = analytic(1.0, "nats", "a smaller fall of the objective changes no decision")
    max_rows_per_channel: int = cost(1000, "rows", "of all batches; longer recordings are thinned")

    # Screen, null and naming
    amplitude_grid: int = analytic(61, "points", "over three sd of a logarithm either way")
    finite_change_sd: float = convention(0.5, "of the change", "prior of a change that was evaluated at one value")
    null_min_misfit_share: float = analytic(0.1, "of the rows", "structure leaves at least so much")
    false_alarms: float = convention(0.01, "probability", "of a claim where nothing is missing: the one knob")
    null_high_quantile: float = analytic(0.95, "probability", "one odd machine in twenty does not decide")
    null_min_scale_nats: float = analytic(1.0, "nats", "of a largest value of many candidates")
    null_min_threshold_nats: float = analytic(5.0, "nats", "odds of 150 to 1")
    screened: int = cost(80, "candidates", "of the screen that are ranked with their prior odds")
    refits: int = cost(10, "refits", "that a round makes")


STRUCTURE = StructurePolicy()
