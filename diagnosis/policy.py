"""Every threshold that changes a decision of the diagnosis, with its unit, its reason and its evidence.

The fields stand in the order of the stages that read them; ``python -m diagnosis.policy`` prints them as the Markdown
tables of the documentation. The diagnosis reads `POLICY`; where an ablation changes a rule, a `Policy` is handed on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any


def threshold(evidence: str, default: Any, unit: str, reason: str) -> Any:
    """A field of `Policy`: how its default is known, the default, its unit, one line of why."""
    return field(default=default, metadata={"unit": unit, "reason": reason, "evidence": evidence})


analytic = partial(threshold, "analytic")  # derived, or a matter of numerics
physical = partial(threshold, "physical")  # from machines and their physics
development = partial(threshold, "development plants")  # measured on plants that share no code with the twin
cost = partial(threshold, "computing time")  # bounds the work
convention = partial(threshold, "convention")  # what is reported, and where a search begins


@dataclass(frozen=True)
class Policy:
    """Thresholds of the diagnosis by stage; gains are in nats of left-out log score."""

    # Fit of a network
    min_batches: int = convention(4, "batches", "with fewer, runs are cut into blocks that are left out in turn")
    min_block_rows: int = convention(24, "rows", "a shorter block shows no transient")
    min_usable_share: float = convention(0.5, "of the batches", "fewer would be other recordings than those given")
    min_rows_per_batch: int = convention(60, "rows, median batch", "a run of ten minutes counts as one of six hours")
    initial_noise_factor: float = convention(3.0, "given noises", "all channels begin alike, so that none is neglected")
    initial_rows_per_value: float = convention(20.0, "rows", "so many rows of a smooth misfit count as one")
    baseline_tolerance: float = analytic(1e-2, "nats", "a smaller fall of the cost changes no decision")
    baseline_steps: int = cost(40, "steps", "bounds the descent from the values of the machine file")
    settle_steps: int = cost(4, "steps per round", "noise and memory are estimated again after them")
    settle_tolerance: float = analytic(0.01, "nats", "a smaller fall of the cost changes no decision")
    settle_rounds: int = cost(10, "rounds", "bounds the rounds of noise and memory")
    settle_max_move_sd: float = analytic(0.1, "prior sd", "a round that moves no parameter further is the last")
    memory_min_rows: int = analytic(20, "rows", "fewer rows of a channel do not show a correlation")
    memory_min_gain_nats: float = analytic(4.0, "nats", "what the two parameters of a memory must be worth")
    min_noise_variance_share: float = physical(0.25, "of the given", "machine files state noise on the safe side")
    min_residual_freedom: float = analytic(0.1, "of the rows", "keeps the noise finite where parameters outnumber rows")

    # Slack of a lumped network
    sensor_place_sd: float = physical(0.1, "of a neighbour's lead", "a sensor in a casting stands in a gradient")
    chain_span_sd: float = physical(0.15, "of a length", "a length of an error chain spans a part of its body")
    small_body_span_sd: float = physical(0.5, "of a length", "its ends are as far apart as its neighbours")
    outside_body_sd: float = physical(0.1, "of the largest gain", "bodies outside an error chain tilt it a little")
    small_body_capacity_share: float = physical(
        0.03, "of the machine", "a smaller body bends nothing that an error shows"
    )
    sensor_lag_sd_s: float = physical(240.0, "s", "lag of a sensor for which the machine file states none")
    held_lag_log_sd: float = physical(1.5, "log", "a lag that the machine file holds fixed")
    film_area_sd: float = physical(0.2, "m2 per W/K", "about all of a film that is stated as a constant is natural")
    run_to_run_log_sd: float = physical(0.05, "log", "no heat and no exposure is the same in every run")
    time_skew_sd_rows: float = analytic(0.1, "rows", "a row is a mean over its interval, which blurs corners")
    logger_skew_sd_rows: float = analytic(0.3, "rows", "a time stamp lies anywhere within its interval, uniformly")

    # Coarse network
    coarse_min_mean_square: float = convention(9.0, "given variances", "three times the noise need no finer network")
    coarse_sensors: int = cost(2, "sensors", "refinements are tried at the worst only")
    near_piece_capacity_share: float = physical(0.15, "of the body", "a piece around a sensor, to begin with")
    near_piece_conductance_factor: float = physical(
        3.0, "of the body's total", "start of the link from a piece to its body"
    )
    far_piece_capacity_share: float = physical(0.4, "of the body", "a piece far from a sensor, to begin with")
    half_body_conductance_factor: float = physical(0.5, "of the body's total", "start of the link between two halves")
    shortcut_conductance_factor: float = physical(0.1, "of the body's total", "start of a shortcut across a body")
    shortcut_log_sd: float = physical(1.5, "log", "prior of a shortcut; wider than that of a piece")
    coarse_log_sd: float = physical(1.0, "log", "prior of a piece's capacity and conductance, and of a doubted value")
    coarse_shortcuts: int = cost(1, "per body", "the pair of neighbours that conduct best")
    coarse_heats: int = cost(1, "per body", "heat that may enter half of the body; one that was found comes first")
    coarse_entry_links: int = cost(1, "per body", "the best conducting links, through which heat may enter a piece")
    coarse_min_refit_gain_nats: float = development(20.0, "nats", "from it on a coarse network may be the cause")
    coarse_first_gain_share: float = development(0.9, "of the best gain", "a finer network is the simpler explanation")
    coarse_alternatives: int = cost(2, "finer networks", "fitted with each effect before one of them is preferred")
    coarse_min_gain_nats: float = development(40.0, "nats", "a finer network claims no physics")

    # Priors of candidates
    doubted_run_to_run_log_sd: float = physical(0.2, "log", "a value that may differ from run to run")
    typical_conductance_W_per_K: float = physical(20.0, "W/K", "a link or exposure of a machine tool's body")
    machine_size_factor: float = physical(10.0, "factor", "within it a machine is of the usual size; priors are wider")
    amplitude_min_log_sd: float = physical(1.5, "log", "machines differ by more than their handbook values")
    amplitude_start_sd: float = convention(2.0, "prior sd", "a screened start lies no further from the usual value")
    signed_prior_sd_factor: float = physical(3.0, "usual spreads", "prior sd of a signed amplitude")
    signed_start_factor: float = convention(2.0, "of the start", "least prior sd, so that the start is plausible")
    signed_usual_sd_factor: float = physical(5.0, "usual spreads", "sd of a signed amplitude when sizes are compared")
    signed_max_square: float = convention(50.0, "squared sd", "bounds what an unusual signed size costs")
    shape_default_sd: float = physical(0.5, "log, or the parameter's unit", "prior of a shape whose law states none")
    shape_parameter_cost_nats: float = analytic(2.0, "nats", "each parameter that shapes an effect (Schwarz 1978)")
    unnamed_equipment_odds: float = physical(0.05, "odds", "a machine file seldom leaves out what the machine has")
    machinery_where_nothing_moves_odds: float = physical(1e-3, "odds", "a board of heaters has no bearings")
    missing_companion_cost_nats: float = physical(3.0, "nats", "a law whose companion is not at its place")
    start_min_amplitude_share: float = convention(1e-3, "of the usual value", "lowest start of a positive amplitude")
    start_share_margin: float = convention(0.005, "share", "a fitted share begins so far from 0 and 1")
    start_max_log_factor: float = convention(2.0, "log", "a doubted value begins no further from the file's")
    amplitude_max_growth: float = convention(100.0, "factor", "bounds the ratio of fitted to screened amplitude")

    # Screening and shortlist
    doubted_value_max_log_factor: float = physical(3.0, "log", "bounds a doubted value in the linear model")
    finite_change_max_amplitude: float = convention(2.0, "usual changes", "bounds candidates without a derivative")
    amplitude_reweighting_rounds: int = cost(3, "rounds", "of channels, in a fold, from the optimum on all batches")
    label_swaps: int = cost(1, "pairs", "exchanged labels are rare; the plainest is tried")
    label_swap_min_gain_nats: float = development(
        60.0, "nats", "33 true swaps gained 70 or more, 37 of 40 false ones under 31"
    )
    label_swap_reweighting_rounds: int = cost(3, "rounds", "what no linear step can fit counts less")
    screen_min_gain_nats: float = convention(0.5, "nats", "a smaller gain in the screen is not looked at")
    screened_candidates: int = cost(80, "candidates", "of the screen that are clustered")
    same_signature_cosine: float = analytic(0.95, "|cos|", "beyond it recordings cannot distinguish two candidates")
    shape_min_gain_nats: float = analytic(5.0, "nats", "what each parameter of a shape must gain in the screen")
    refits_best: int = cost(5, "refits", "the best of the screen in every round")
    refits_with_other_mechanisms: int = cost(7, "refits", "together with the best of every other mechanism")
    refits_of_strong_mechanisms: int = development(3, "refits", "a strong effect has many imitators")
    strong_gain_share: float = development(0.25, "of the best gain", "from it on a mechanism counts as a strong one")
    refit_min_screen_gain_nats: float = development(5.0, "nats", "true effects had 26 or more in 112 cases")
    refits_unconditional: int = development(2, "refits", "a baseline bent by what it lacks shows little in the screen")
    sharp_refits: int = cost(2, "refits", "candidates at errors that only rows without memory show")
    sharp_gain_share: float = development(0.1, "of the best gain there", "a weaker one is not refitted")
    revisited_places: int = cost(2, "places", "of the best refits, before a round ends without a claim")
    refits_per_revisited_place: int = cost(3, "refits", "an effect that is not linear shows little in the screen")
    placement_refits: int = cost(6, "refits", "other placements of a law with an open shape")
    unseen_min_batches: int = analytic(2, "batches", "on either side of a season or speed that is left out")
    unseen_top_share: float = convention(0.9, "of the highest value", "batches that reach it are the fastest")

    # Refits
    refit_steps: int = cost(1, "steps", "whether a candidate is in the running needs no more")
    refit_tolerance: float = cost(0.1, "nats", "a refit only ranks candidates")
    short_refit_gain_share: float = development(
        0.5, "of the screen's", "a refit that gains less does not represent its cluster"
    )
    continued_refits: int = cost(2, "refits", "that are fitted on, and as many others of their clusters")
    continued_min_screen_gain_nats: float = cost(20.0, "nats", "below it a refit that fell short is not worth its time")
    discounted_channel_noise_factor: float = development(
        2.0, "given noises", "the fit hardly counts a channel beyond it"
    )
    equal_weight_steps: int = cost(3, "steps", "of a refit at a discounted error, all rows counted alike")
    equal_weight_settle_steps: int = cost(2, "steps per round", "after it, with noise and memory estimated")
    equal_weight_settle_rounds: int = cost(2, "rounds", "bounds the rounds of noise and memory there")
    finalist_settle_rounds: int = development(4, "rounds", "with ten, 11 gains of 11 to 900 nats rose by 4 at most")
    start_amplitude_shares: tuple[float, ...] = convention(
        (0.3, 0.1, 0.03),
        "of the screen's amplitude",
        "starts in turn, where a machine with all of it cannot be simulated",
    )
    finalists: int = cost(4, "refits", "that are fitted to their optimum and may be claimed")
    finalist_min_null_share: float = development(0.25, "of the null threshold", "weaker refits are not fitted on")
    cluster_member_refits: int = cost(2, "refits", "of those that look like a finalist, the likeliest")
    member_max_deficit: float = development(2.0, "log weight", "a member further below the best is not refitted")
    member_max_gain_loss: float = development(0.15, "of its gain", "one linear step may make so small a difference")
    second_pass_min_gain_nats: float = development(20.0, "nats", "of a refit that calls for a second pass")
    second_pass_finalists: int = cost(2, "refits", "that are fitted to their optimum in the second pass")
    second_pass_min_finalist_gain_nats: float = development(40.0, "nats", "one step may gain a tenth of the optimum")

    # Acceptance
    impossible_min_noises: float = analytic(5.0, "given noises", "by chance one row in two million is so far off")
    impossible_min_rows: int = convention(3, "rows", "a single one may be a fault of the recording")
    max_worse_share: float = development(0.25, "of the left-out batches", "an effect makes few runs worse")
    claim_min_gain_share: float = development(0.5, "of the highest gain", "what improves most batches comes first")
    alternatives_judged: int = cost(2, "finalists", "after one whose own null speaks against it")
    joint_gain_share: float = development(0.4, "of its gain alone", "an effect that keeps as much is not explained")
    nothing_max_odds: float = analytic(20.0, "odds", "of no effect against a claim")
    sign_flips: int = cost(60, "draws", "of random signs of the residuals, run by run")
    chance_quantile: float = convention(0.99, "probability", "what chance exceeds once in a hundred cases is no claim")
    own_quantile_min_nats: float = analytic(20.0, "nats", "the scatter of smaller chance gains says nothing")
    run_to_run_min_sd: float = physical(0.02, "log", "no heat is the same from run to run to less")
    even_odds_gain_nats: float = development(110.0, "nats", "half of the claims on other numerics were false there")
    odds_gain_exponent: float = development(2.4, "log odds per log gain", "how trust grows with the gain")
    odds_cost_worse_batch: float = development(1.2, "log odds", "each batch that gets worse")
    odds_cost_network: float = development(1.5, "log odds", "what only says how a network is drawn")
    odds_cost_lever: float = development(1.4, "log odds", "false levers gained up to 253 nats, true ones 343")
    odds_cost_labels: float = development(4.5, "log odds", "false exchanges gained up to 630 nats, true ones from 1200")
    max_effects: int = cost(4, "effects", "of one search")
    max_rounds_per_effect: int = cost(2, "rounds", "finer networks take rounds, too")
    baseline_restarts: int = cost(2, "rounds", "a round begins again from a better baseline that its refit showed")
    baseline_restart_min_gain_nats: float = analytic(2.0, "nats", "by which that baseline is better")
    baseline_restart_min_gain_share: float = development(
        0.3, "of the effect's", "a smaller gain leads to the same claim"
    )
    exchanged_alternatives: int = cost(2, "per effect", "that are tried in its place in backward elimination")
    exchange_gain_share: float = development(
        0.5, "of the effect's gain", "an alternative that gained as much may replace it"
    )
    exchange_min_gain_nats: float = analytic(3.0, "nats", "by which an alternative must fit better than the effect")
    needless_max_loss_share: float = development(0.5, "of its accepted gain", "an effect that still loses more stays")
    elimination_steps: int = cost(4, "steps per round", "of the fit without an effect")
    elimination_tolerance: float = cost(0.05, "nats", "of the fit without an effect")
    elimination_rounds: int = cost(2, "rounds", "of the fit without an effect")

    # Structural null
    null_machines: int = cost(14, "machines", "refined machines with random details")
    null_min_machines: int = analytic(3, "machines", "fewer give no quantile, and nothing is accepted")
    null_cells: int = cost(5, "cells", "of each body that is cut into a bar")
    null_biot: tuple[float, float] = physical((0.03, 0.5), "Biot number", "of a body cut into a bar")
    null_length_centre: tuple[float, float] = physical((0.25, 0.75), "of a body", "where the mean of a length lies")
    null_scales: tuple[float, ...] = physical(
        (0.3, 1.0, 3.0, 8.0), "of each misfit", "real castings are finer than bars of five cells"
    )
    null_margin: float = development(1.25, "factor", "on a quantile of so few machines")
    amplitude_scatter_factor: float = development(
        2.0, "factor", "plants of other numerics scatter more than refined networks"
    )
    amplitude_scatter_quantile: float = convention(0.9, "probability", "of null amplitudes; signed ones two-sided")
    null_amplitude_bound_factor: float = convention(10.0, "of the fitted size", "bounds amplitudes under the null")
    temperature_bounds_nats: tuple[float, float] = development(
        (8.0, 16.0), "nats", "wrong explanations led by up to 28"
    )
    temperature_null_share: float = development(0.25, "of the median null gain", "scale on which scores are compared")

    # Probability
    few_runs_max_probability: tuple[float, ...] = analytic(
        (0.6, 0.7, 0.8, 0.9, 0.93), "probability of 1, 2, … runs", "few runs agree by chance"
    )
    max_probability: float = convention(0.99, "probability", "of more runs: no set of candidates is complete")
    unlisted_odds: float = development(50.0, "odds", "of the best explanation against what is not listed")
    alike_min_probability_share: float = convention(0.25, "of the likeliest", "an explanation as probable is alike")
    reported_min_probability: float = convention(0.005, "probability", "a less likely alternative is not reported")
    reported_alternatives: int = convention(5, "alternatives", "in the findings")

    # Localisation
    knot_spacing_s: float = physical(1800.0, "s", "the capacity of any body smooths faster heat")
    max_knots: int = cost(25, "per batch", "longer batches have them further apart")
    series_correlation_s: float = physical(5400.0, "s", "of a free series, which may jump where something is switched")
    peaked_gain_nats: float = analytic(5.0, "nats", "above it the Laplace approximation of the evidence holds")
    place_min_evidence_nats: float = analytic(5.0, "nats", "odds of 150 to 1, beyond the number of places")
    place_min_evidence_share: float = analytic(0.01, "of the first place", "hats and linearisation may leave as much")
    rough_amplitude_margin_nats: float = cost(200.0, "nats", "what a rough amplitude may cost a place")
    place_noise_rounds: int = cost(5, "rounds", "of the noise with all places held")
    linear_step_max_sd: float = analytic(3.0, "prior sd", "beyond it a linearised model says little")
    linear_step_settled_sd: float = analytic(0.3, "prior sd", "parameters that move less are where they were")
    linearisations: int = cost(3, "linearisations", "beyond them places and series hardly change")
    located_places: int = cost(3, "places", "that are located one after the other")
    regime_min_row_share: float = convention(0.005, "of all rows", "rarer regimes are left out of the map")

    # Effects of no listed mechanism
    unlisted_min_gain_ratio: float = development(1.25, "of the listed gain", "unlisted physics must clearly do better")
    unlisted_min_screen_gain_nats: float = cost(10.0, "nats", "a term with less in the screen is not refitted")
    unlisted_refits: int = cost(2, "refits", "of each screen: with the rows' memory and without")
    unlisted_close_gain_share: float = development(
        0.8, "of the best refit", "such a term may be the best at its optimum"
    )
    unlisted_max_terms: int = convention(3, "terms", "of one effect")
    term_min_gain_nats: float = analytic(3.0, "nats", "what a further term must gain; closer terms are alike")
    term_min_gain_share: float = analytic(0.02, "of the gain so far", "a smaller one only improves the form of others")

    # Next experiment
    clear_probability: float = convention(0.9, "probability", "above it no run is proposed")
    alternative_min_probability: float = convention(0.05, "probability", "a less likely alternative is not worth a run")
    separated_alternatives: int = cost(3, "alternatives", "that a run is chosen to separate")
    settling_nats: float = analytic(5.0, "nats", "odds of 150 to 1")
    telling_nats: float = analytic(1.0, "nats", "less than odds of 3 to 1 separates nothing")
    sensor_cost_h: float = physical(2.0, "h", "to mount one more sensor")
    prediction_max_refinement: int = cost(2, "steps per row", "both sides of a comparison share the simulation's error")
    extra_sensor_offset_sd_K: float = physical(0.3, "K", "of one more sensor")
    extra_sensor_noise_K: float = physical(0.1, "K", "of one more sensor, where no other says what is usual")
    short_recording_h: float = convention(3.0, "h", "after shorter recordings runs are shorter in proportion")
    slow_run_speed_share: float = physical(0.2, "of the highest speed", "little friction heat, but convection")
    staircase_speed_shares: tuple[float, ...] = physical(
        (0.25, 0.5, 0.75, 1.0), "of the highest speed", "separate powers of speed"
    )
    rest_before_run_h: float = physical(24.0, "h", "a machine tool is at rest then")
    warm_up_h: float = physical(4.0, "h", "before a cool-down")
    night_fall_K: float = physical(6.0, "K", "a hall over a night")
    hall_heating_K: float = physical(5.0, "K", "a hall that is heated in the morning")
    morning_h: float = convention(7.0, "h, time of day", "a shop begins its runs")
    evening_h: float = convention(21.0, "h, time of day", "a night begins")

    # Drafting of a network
    draft_max_batches: int = cost(12, "batches", "evenly over those given")
    draft_min_parts: int = convention(4, "batches or blocks", "so that some can be left out")
    draft_rows_per_batch: int = cost(48, "rows", "a body that answers within a fiftieth of a run is not drafted")
    draft_max_step_s: float = physical(600.0, "s", "between thinned rows")
    draft_min_rows: int = analytic(6, "rows", "of a batch or block")
    draft_min_channel_share: float = convention(0.5, "of the batches", "in which a driver or an ambient has values")
    ambient_min_range_K: float = physical(0.3, "K", "an ambient that moves less drives nothing")
    ambient_range_tail: float = convention(0.02, "probability", "left out at either end of that range")
    draft_min_noise: tuple[tuple[str, float], ...] = physical(
        (("degC", 0.01), ("um", 0.1)), "the named unit", "no channel has less noise"
    )
    draft_min_noise_share: float = convention(1e-3, "of a channel's range", "the same where its unit states none")
    draft_small_rise_share: float = convention(0.1, "of the median rise", "smaller rises have no shape to compare")
    draft_min_offset_batches: int = analytic(3, "batches", "from which on first readings give a sensor's offset")
    draft_max_time_constant: float = analytic(20.0, "durations of a part", "recordings show no slower one")
    draft_min_time_constant: float = analytic(3.0, "rows", "rows show no faster one")
    draft_equal_capacity_weight: float = convention(
        0.3, "weight", "of equal capacities against the ratios that links give"
    )
    draft_max_log_capacity_ratio: float = convention(4.0, "log", "what one link may say of two capacities")
    draft_held_heat_W: float = physical(300.0, "W", "spindles of some kilowatts lose a few hundred watts")
    draft_heat_log_sd: float = physical(1.0, "log", "prior of a drafted heat")
    draft_speed_exponent: float = physical(1.5, "power of speed", "friction and windage grow as n^1 to n^2.5")
    draft_speed_exponent_sd: float = physical(0.3, "power of speed", "prior that reaches from n^1 to n^2")
    draft_guide_friction: float = physical(0.1, "friction coefficient", "lubricated guides of a machine tool")
    draft_log_sd: float = physical(1.0, "log", "prior of a capacity or conductance: a factor of 2.7")
    draft_share_bounds: tuple[float, float] = analytic((1e-3, 0.999), "share", "a share at its end would be none")
    draft_start_share_bounds: tuple[float, float] = convention((0.03, 0.9), "share", "of a heat, to begin with")
    draft_min_heat_share: float = convention(1e-3, "of the held heat", "of any other heat, to begin with")
    draft_heat_outlets: int = convention(2, "bodies", "that a heat goes into")
    draft_min_outlet_share: float = convention(0.02, "of a heat", "into a body")
    draft_chain_bodies: tuple[int, int] = convention((2, 4), "bodies", "of an error chain, at least and at most")
    draft_chain_min_fall: float = convention(0.05, "of the error's rms", "for one body more")
    draft_held_capacity_J_per_K: float = physical(10e3, "J/K", "held where nothing heats")
    draft_gain_sd_um_per_K: float = physical(10.0, "um/K", "prior of an error chain's gain")
    draft_start_sd_K: float = physical(0.5, "K", "of a body's start")
    draft_offset_sd_K: float = physical(0.5, "K", "of a sensor, beyond what first readings say")
    draft_folds: int = cost(4, "folds", "parts that are left out in turn")
    draft_misfit_share: float = development(0.1, "of the movement", "what a drafted network leaves; weights the rows")
    draft_rows_per_value: float = development(10.0, "rows", "so many rows of a smooth misfit count as one")
    draft_steps: int = cost(30, "steps", "of the fit to all parts")
    draft_fold_steps: int = cost(10, "steps", "of the fit without a fold")
    draft_tolerance: float = analytic(1e-3, "nats per row", "a smaller fall of the cost changes no decision")
    draft_min_fall: float = convention(0.03, "of what is left", "for a body or a set of links more")
    draft_patience: int = cost(2, "counts of bodies", "without improvement, after which the search ends")
    draft_max_bodies: int = cost(8, "bodies", "of a drafted network")

    # Findings
    active_min_share: float = convention(0.1, "of the largest watts or size", "an effect is at work above it")
    always_min_share: float = convention(0.95, "of the time", "an effect at work for longer is always at work")
    active_min_level: float = convention(
        0.5, "of a law's own activity", "a law that states its activity works above it"
    )
    structure_error_share: float = development(0.025, "of the movement", "what a network of castings usually leaves")
    residual_max_units: float = development(
        6.0, "structural errors", "267 complete cases left 1.5 in the median, 5.1 at most"
    )
    few_runs_residual_max_units: float = development(4.0, "structural errors", "few runs prove less")
    few_runs: int = convention(6, "runs", "below it runs are few, and a finding says so")
    lumped_amplitude_sd: float = development(
        0.5, "of an amplitude", "with it 207 of 231 intervals held the true amplitude"
    )
    idle_prior_share: float = analytic(1.0 - 1e-9, "of the prior sd", "a parameter that keeps it does nothing there")
    stands_alone_probability: float = convention(0.7, "probability", "with a tie below it nothing is decided")
    untied_probability: float = convention(0.9, "probability", "above it no alternative is tied")
    tied_min_probability_share: float = convention(0.5, "of the explanation", "an alternative as probable is tied")
    plain_probability: float = convention(0.9, "probability", "above it a claim is stated plainly")
    likely_probability: float = convention(0.6, "probability", "above it a claim is most likely, below it perhaps")
    fallen_max_share: float = convention(0.98, "of the error before", "an error that keeps more has not fallen")
    noise_max_ratio: float = convention(1.5, "times the given noise", "a channel up to it is noise")
    limit_power_sd: float = analytic(1.64, "sd", "an effect at its limit is seen in 95 of 100 such sets of runs")
    limit_absorbed_share: float = convention(0.3, "of a signature", "from it on the hiding parameter is named")

    # Rules that an ablation takes out
    counts_row_memory: bool = analytic(True, "yes or no", "rows that repeat each other count for less")
    leaves_batches_out: bool = analytic(True, "yes or no", "a gain on the rows that were fitted rewards freedom")
    uses_structural_null: bool = development(
        True, "yes or no", "a lumped network leaves structure that looks like physics"
    )
    checks_residual: bool = development(True, "yes or no", "what is left may show that something else is missing")

    @property
    def null_own_scale(self) -> int:
        """The number of the scale at which the misfit of a refined machine is its own."""
        return self.null_scales.index(1.0)


POLICY = Policy()

STAGES = {  # the first field of each
    "min_batches": "Fit of a network",
    "sensor_place_sd": "Slack of a lumped network",
    "coarse_min_mean_square": "Coarse network",
    "doubted_run_to_run_log_sd": "Priors of candidates",
    "doubted_value_max_log_factor": "Screening and shortlist",
    "refit_steps": "Refits",
    "max_worse_share": "Acceptance",
    "null_machines": "Structural null",
    "few_runs_max_probability": "Probability",
    "knot_spacing_s": "Localisation",
    "unlisted_min_gain_ratio": "Effects of no listed mechanism",
    "clear_probability": "Next experiment",
    "draft_max_batches": "Drafting of a network",
    "active_min_share": "Findings",
    "counts_row_memory": "Rules that an ablation takes out",
}


def markdown() -> Iterator[str]:
    """The lines of the documentation's page: one table per stage."""
    yield "# The policy of the diagnosis: every threshold"
    yield ""
    yield "`diagnosis/policy.py` holds every number that changes a decision. Gains are in nats of left-out log score."
    yield "This page is generated: `python -m diagnosis.policy > docs/policy.md`."
    for f in fields(Policy):
        if f.name in STAGES:
            yield from ("", f"## {STAGES[f.name]}", "", "| threshold | default | unit | why | evidence |")
            yield "|---|---|---|---|---|"
        about = f.metadata
        yield f"| `{f.name}` | {f.default} | {about['unit']} | {about['reason']} | {about['evidence']} |"


if __name__ == "__main__":
    print("\n".join(markdown()))
