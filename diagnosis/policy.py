"""Every threshold that changes a decision of the diagnosis, with its unit, its reason and its evidence.

The fields are in the order of the stages that read them; ``python -m diagnosis.policy`` prints them as the Markdown
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
    initial_noise_factor: float = convention(
        3.0, "given noises", "the same for all channels, so that none is neglected"
    )
    initial_rows_per_value: float = convention(20.0, "rows", "so many rows of a smooth misfit count as one")
    first_steps: int = cost(40, "steps", "bounds the descent from the values of the machine file")
    baseline_steps: int = cost(12, "steps", "under each covariance")
    nuisance_rounds: int = cost(2, "rounds", "of the fit's values and the runs' nuisances in turn")
    deterministic_steps: int = cost(20, "steps", "of a deterministic fit; most end after ten")

    # Refined twins and their covariance
    refined_twins: int = cost(100, "draws", "directions of structure")
    drawn_exponent_log_sd: float = physical(0.25, "log", "heat grows with speed by other powers than a law states")
    left_out_shares: tuple[float, ...] = convention((1.0, 0.5, 0.25, 0.125), "of a step", "each half of the one before")
    drawn_max_misfit: float = convention(10.0, "of the largest change recorded", "feedback of a draw that runs away")
    drawn_cells: tuple[int, int] = physical((3, 8), "cells", "of a body that is cut into a chain")
    drawn_length_centre: tuple[float, float] = physical((0.25, 0.75), "of a body", "where the mean of a length lies")
    inner_conductance: tuple[float, float] = physical(
        (0.7, 0.7), "of what leaves the body, median; log sd", "castings have Biot numbers about 1"
    )
    thin_body_share: float = physical(0.25, "probability", "screws and sheets conduct far less than they exchange")
    thin_body_conductance: tuple[float, float] = physical((0.1, 1.0), "as above", "of a thin body")
    webbed_share: float = physical(0.5, "probability", "ribs and webs conduct around a chain")
    web_conductance: tuple[float, float] = physical(
        (0.1, 1.0), "of the inner conductance", "each, from weak to as good as the chain"
    )
    stray_conductance: float = physical(
        0.05, "of the weaker total", "bodies that almost touch, between second neighbours"
    )
    leak_share: float = physical(0.15, "of a heat", "at most, into a neighbour of the body that it is drawn into")
    start_gradient_share: float = physical(0.1, "of the file's initial spread", "what a machine has done before")
    start_gradient_min_sd_K: float = physical(0.03, "K", "no body is at one temperature")
    drawn_timing_rows: float = analytic(0.5, "rows", "a row does not say when within it a driver changed")
    run_to_run_log_sd: float = physical(0.05, "log", "no heat is the same in every run")
    draw_max_size: float = analytic(4.0, "median draws", "a larger one would be the only direction")
    specific_shares: tuple[float, ...] = analytic(
        (0.0, 0.3, 1.0, 4.0), "of a draw's specific variance", "grid of the likelihood"
    )
    timing_shares: tuple[float, ...] = analytic(
        (0.0, 0.3, 1.0),
        "of the variance by times of changes",
        "grid of the likelihood: a recorder may keep to its rows",
    )
    structure_scales: tuple[float, ...] = analytic(
        (0.0, 0.06, 0.125, 0.25, 0.5, 1.0), "of the draws", "grid of the likelihood; what is larger is an effect"
    )
    imperfection_scales: tuple[float, ...] = analytic((0.0, 0.25, 0.5, 1.0), "of their sd", "grid of the likelihood")
    start_scales: tuple[float, ...] = analytic((0.1, 0.3, 1.0), "of the file's spread", "grid of the likelihood")
    first_hyper: tuple[float, ...] = convention(
        (0.5, 0.25, 1.0), "of each", "where the climb to the likeliest sizes begins"
    )
    hyper_rounds: int = cost(2, "rounds", "of sizes and values in turn")
    noise_min_rows: int = analytic(10, "rows", "fewer second differences show no noise")
    noise_kept_share: float = analytic(0.95, "of the rows", "the rest are jumps of a driver")
    noise_kept_factor: float = analytic(1.15, "factor", "what that share lacks of a normal distribution's rms")
    rounded_min_share: float = convention(0.05, "of the rows", "that repeat: the channel is rounded")
    white_noise_bounds: tuple[float, float] = physical((0.5, 5.0), "given noises", "what a machine file may be off by")
    channel_rounds: int = cost(2, "rounds", "of noise that no refined twin shows")
    channel_min_excess: float = analytic(1.1, "sd", "less is chance")
    fit_steps: int = cost(6, "steps", "of a refit; most end after three")
    fit_tolerance_nats: float = analytic(0.1, "nats", "a smaller drop of the cost changes no decision")
    damping_tries: int = cost(7, "steps", "shorter each time, before a fit ends")
    damping_start: float = convention(1e-3, "of the curvature", "of the first shorter step")
    damping_factor: float = convention(6.0, "factor", "from one shorter step to the next")

    # Imperfections of any machine
    sensor_place_sd: float = physical(0.1, "of a neighbour's lead", "a sensor in a casting is in a gradient")
    chain_span_sd: float = physical(0.15, "of a length", "a length of an error chain spans a part of its body")
    small_body_span_sd: float = physical(0.5, "of a length", "its ends are as far apart as its neighbours")
    outside_body_sd: float = physical(0.1, "of the largest gain", "bodies outside an error chain tilt it a little")
    small_body_capacity_share: float = physical(
        0.03, "of the machine", "a smaller body bends nothing that an error shows"
    )
    sensor_bonding_sd: float = physical(0.03, "share", "a sensor sees a little of the air")
    sensor_offset_sd_K: float = physical(0.05, "K", "of a sensor for which the machine file states none")
    sensor_lag_sd_s: float = physical(240.0, "s", "lag of a sensor for which the machine file states none")
    held_lag_log_sd: float = physical(1.5, "log", "a lag that the machine file holds fixed")
    rising_film_share: float = physical(
        0.35, "of an exposure", "about all of a film is natural convection and radiation"
    )
    rising_W_per_m2K: float = analytic(2.7, "W/m2K", "natural convection at 6 K: McAdams 1954, 0.5 m high")

    # Priors of candidates
    doubted_value_log_sd: float = physical(1.0, "log", "prior of a value of the machine file that is doubted")
    typical_conductance_W_per_K: float = physical(20.0, "W/K", "a link or exposure of a machine tool's body")
    machine_size_factor: float = physical(10.0, "factor", "within it a machine is of the usual size; priors are wider")
    amplitude_min_log_sd: float = physical(1.5, "log", "machines differ by more than their handbook values")
    amplitude_start_sd: float = convention(2.0, "prior sd", "a screened start lies no further from the usual value")
    signed_prior_sd_factor: float = physical(3.0, "usual spreads", "prior sd of a signed amplitude")
    unusual_size_factor: float = convention(
        1000.0,
        "sd in the screen",
        "prior sd of an amplitude without a usual size: a bent fit may show a hundredth of it",
    )
    signed_start_factor: float = convention(2.0, "of the start", "least prior sd, so that the start is plausible")
    shape_default_sd: float = physical(0.5, "log, or the parameter's unit", "prior of a shape whose law states none")
    unnamed_equipment_odds: float = physical(0.05, "odds", "a machine file seldom leaves out what the machine has")
    machinery_where_nothing_moves_odds: float = physical(1e-3, "odds", "a board of heaters has no bearings")
    missing_companion_cost_nats: float = physical(3.0, "nats", "a law whose companion is not at its place")
    start_min_amplitude_share: float = convention(1e-3, "of the usual value", "lowest start of a positive amplitude")
    start_share_margin: float = convention(0.005, "share", "a fitted share begins so far from 0 and 1")

    # Screening and refits
    screen_amplitude_noises: float = physical(10.0, "given noises", "sd of a signature in the channel it changes most")
    screened_scales: int = cost(3, "scales of structure", "the likeliest without an effect and smaller ones")
    refit_min_gain_share: float = development(
        0.12,
        "of what a claim needs",
        "of 76 refits with a quarter of that, 72 were promised this; no other was right",
    )
    unlisted_term_cost_nats: float = analytic(1.0, "nats", "of equal gains a listed law comes first")
    run_windows: int = cost(12, "parts of a run", "in which what happens once is looked for")
    form_places: int = cost(4, "places", "at which products and squares of drivers are looked for")
    free_form_credit: float = development(0.9, "of its gain", "free forms imitate any law to within a tenth")
    refits: int = cost(10, "refits", "of a round; each takes seconds")
    refits_of_mechanism: int = cost(3, "refits", "of one mechanism at several places")
    same_signature_cosine: float = analytic(0.95, "|cos|", "beyond it recordings cannot distinguish two candidates")
    label_swaps: int = cost(1, "pairs", "exchanged labels are rare; the plainest is tried")
    label_swap_min_gain_nats: float = development(
        60.0, "nats", "33 true swaps gained 70 or more, 37 of 40 false ones under 31"
    )
    label_swap_reweighting_rounds: int = cost(3, "rounds", "what no linear step can fit counts less")

    usual_error_sd: float = analytic(2.0, "sd of an imperfection", "19 of 20 sensors and lengths are off by less")

    # Claims
    impossible_min_noises: float = analytic(5.0, "given noises", "by chance one row in two million is so far off")
    impossible_min_rows: int = convention(3, "rows", "a single one may be a fault of the recording")
    unseen_start_sd: float = analytic(2.0, "sd", "by which a body without a sensor may start off")
    claim_offset: float = development(
        4.54, "log odds", "a logistic fit of 82 claims of first rounds, 45 of them right: results/claims.csv"
    )
    claim_weight: float = development(1.11, "log odds", "of the same fit, for the logarithm of the relative gain")
    claim_min_probability: float = convention(
        0.7, "probability", "a false claim costs more than twice as much as a missed one"
    )
    confirmed: int = cost(3, "explanations", "of a round; structure drawn anew for each takes as long as a baseline")
    temperature_share: float = convention(0.05, "of the gain", "by as much structure scatters what explanations gain")
    temperature_min_nats: float = development(3.0, "nats", "wrong explanations lead by as much")
    max_effects: int = cost(4, "effects", "of one search")

    # Probability
    few_runs_max_probability: tuple[float, ...] = analytic(
        (0.6, 0.7, 0.8, 0.9, 0.93), "probability of 1, 2, … runs", "few runs agree by chance"
    )
    max_probability: float = convention(0.99, "probability", "of more runs: no set of candidates is complete")
    unlisted_odds: float = development(50.0, "odds", "of the best explanation against what is not listed")
    tied_min_probability_share: float = convention(0.25, "of the likeliest", "an explanation as probable is tied")
    reported_min_probability: float = convention(0.005, "probability", "a less likely alternative is not reported")
    named_min_probability_share: float = convention(0.1, "of the finding", "a less likely one does not count as named")
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
    linear_step_max_sd: float = analytic(3.0, "prior sd", "beyond it a linearised model is inaccurate")
    linear_step_converged_sd: float = analytic(0.3, "prior sd", "parameters that move less are where they were")
    linearisations: int = cost(3, "linearisations", "beyond them places and series hardly change")
    located_places: int = cost(3, "places", "that are located one after the other")
    regime_min_row_share: float = convention(0.005, "of all rows", "rarer regimes are left out of the map")

    # Next experiment
    clear_probability: float = convention(0.9, "probability", "above it no run is proposed")
    alternative_min_probability: float = convention(0.05, "probability", "a less likely alternative is not worth a run")
    separated_alternatives: int = cost(3, "alternatives", "that a run is chosen to separate")
    decisive_nats: float = analytic(5.0, "nats", "odds of 150 to 1")
    negligible_nats: float = analytic(1.0, "nats", "less than odds of 3 to 1 separates nothing")
    sensor_cost_h: float = physical(2.0, "h", "to mount one more sensor")
    prediction_max_refinement: int = cost(2, "steps per row", "both sides of a comparison share the simulation's error")
    extra_sensor_offset_sd_K: float = physical(0.3, "K", "of one more sensor")
    extra_sensor_noise_K: float = physical(0.1, "K", "of one more sensor, where no other shows the usual value")
    short_recording_h: float = convention(3.0, "h", "after shorter recordings runs are shorter in proportion")
    slow_run_speed_share: float = physical(0.2, "of the highest speed", "little friction heat, but convection")
    staircase_speed_shares: tuple[float, ...] = physical(
        (0.25, 0.5, 0.75, 1.0), "of the highest speed", "separate powers of speed"
    )
    rest_before_run_h: float = physical(24.0, "h", "a machine tool is at rest then")
    warm_up_h: float = physical(4.0, "h", "before a cool-down")
    night_drop_K: float = physical(6.0, "K", "a hall over a night")
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
    draft_max_log_capacity_ratio: float = convention(4.0, "log", "of two capacities, by one link")
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
    draft_chain_min_drop: float = convention(0.05, "of the error's rms", "for one body more")
    draft_held_capacity_J_per_K: float = physical(10e3, "J/K", "held where nothing heats")
    draft_gain_sd_um_per_K: float = physical(10.0, "um/K", "prior of an error chain's gain")
    draft_start_sd_K: float = physical(0.5, "K", "of a body's start")
    draft_offset_sd_K: float = physical(0.5, "K", "of a sensor, beyond its first readings")
    draft_folds: int = cost(4, "folds", "parts that are left out in turn")
    draft_misfit_share: float = development(0.1, "of the movement", "residual of a drafted network; weights the rows")
    draft_rows_per_value: float = development(10.0, "rows", "so many rows of a smooth misfit count as one")
    draft_steps: int = cost(30, "steps", "of the fit to all parts")
    draft_fold_steps: int = cost(10, "steps", "of the fit without a fold")
    draft_tolerance: float = analytic(1e-3, "nats per row", "a smaller drop of the cost changes no decision")
    draft_min_drop: float = convention(0.03, "of what is left", "for a body or a set of links more")
    draft_patience: int = cost(2, "counts of bodies", "without improvement, after which the search ends")
    draft_max_bodies: int = cost(8, "bodies", "of a drafted network")

    # Findings
    active_min_share: float = convention(0.1, "of the largest watts or size", "an effect is at work above it")
    always_min_share: float = convention(0.95, "of the time", "an effect at work for longer is always at work")
    active_min_level: float = convention(
        0.5, "of a law's own activity", "a law that states its activity works above it"
    )
    structure_error_share: float = development(0.025, "of the movement", "usual residual of a network of castings")
    residual_max_units: float = development(
        6.0, "structural errors", "267 complete cases left 1.5 in the median, 5.1 at most"
    )
    few_runs_residual_max_units: float = development(4.0, "structural errors", "few runs prove less")
    few_runs: int = convention(6, "runs", "below it a finding states that runs are few")
    lumped_amplitude_sd: float = development(
        0.5, "of an amplitude", "with it 207 of 231 intervals held the true amplitude"
    )
    idle_prior_share: float = analytic(1.0 - 1e-9, "of the prior sd", "a parameter that keeps it does nothing there")
    stands_alone_probability: float = convention(0.7, "probability", "with a tie below it nothing is decided")
    untied_probability: float = convention(0.9, "probability", "above it no alternative is tied")
    unhedged_probability: float = convention(0.9, "probability", "above it a claim is stated without a hedge")
    likely_probability: float = convention(0.6, "probability", "above it a claim is most likely, below it perhaps")
    reduced_max_share: float = convention(0.98, "of the error before", "an error that keeps more is not reduced")
    noise_max_ratio: float = convention(1.5, "times the given noise", "a channel up to it is noise")
    limit_power_sd: float = analytic(1.64, "sd", "an effect at its limit is detected in 95 of 100 sets of runs")
    limit_absorbed_share: float = convention(0.3, "of a signature", "from it on the hiding parameter is named")

    # Rules that an ablation takes out
    checks_residual: bool = development(True, "yes or no", "what is left may show that something else is missing")


POLICY = Policy()

STAGES = {  # the first field of each
    "min_batches": "Fit of a network",
    "refined_twins": "Refined twins and their covariance",
    "sensor_place_sd": "Imperfections of any machine",
    "doubted_value_log_sd": "Priors of candidates",
    "screen_amplitude_noises": "Screening and refits",
    "impossible_min_noises": "Claims",
    "few_runs_max_probability": "Probability",
    "knot_spacing_s": "Localisation",
    "clear_probability": "Next experiment",
    "draft_max_batches": "Drafting of a network",
    "active_min_share": "Findings",
    "checks_residual": "Rules that an ablation takes out",
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
