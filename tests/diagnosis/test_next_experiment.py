"""The run that tells alternatives apart: the menu, what each run would say, and the chosen one carried out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch
from data.errors import InputError
from data.machine import Machine, load_machine
from diagnosis.contracts import Candidate, Point, Scored, Where
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import calibrated
from diagnosis.next_experiment.foreseen import AlternativeModel, begun, foreseen, with_free_offset
from diagnosis.next_experiment.menu import Run, menu
from diagnosis.next_experiment.proposal import COLUMNS, NOTHING, Proposal, next_experiment, revealing_run
from diagnosis.policy import POLICY
from diagnosis.search.claims import Round, Tried, figures
from diagnosis.search.search import Search
from tests.diagnosis.concealed import chain, empty
from tests.twin.machines import machine
from tests.twin.recordings import empty_batches, recorded
from twin.calibration.least_squares import FitOptions, State, converge
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.run_plan import RunPlan, load_run_plan
from twin.run_plan.plan import Stage
from twin.schema import twin_part
from twin.simulation import simulate
from twin.simulation.inputs import inputs_of_plan

MACHINES = Path(__file__).parents[2] / "machines"
SPIN = {"law": "rotating_convection", "drivers": "rpm", "acts_on": "shaft-room",
        "parameters": {"gain": {"value": 3, "spread": 0.7}}}  # fmt: skip
AIR = {"mechanisms__spin": SPIN}  # the shaft's air takes more heat the faster it turns
LOSS = {"exposures__shaft-room": {"value": "3 W/K", "spread": 0.7}}  # or more at any speed


def state_of(of: Machine, batches: Sequence[Batch], reweight: bool = True) -> tuple[CalibrationProblem, State]:
    problem = CalibrationProblem.of(compile_network(of), batches)
    return problem, converge(problem, FitOptions(tolerance=1e-3, reweight=reweight))[0]


def fitted(of: Machine, batches: Sequence[Batch]) -> Fitted:
    problem, state = state_of(of, batches)
    return calibrated(Point(of, twin_part(of), tuple(batches), problem, state.z, state.nuisance, 0.0), state.noise)


@cache
def tied(bare: bool = False) -> dict[str, Fitted]:
    """Two alternatives and recordings at one speed, which tell little of them; `bare`: no sensor on the shaft."""
    changes: dict[str, Any] = {"sensors__t_shaft": None} if bare else {}
    air, loss = machine(**AIR, **changes), machine(**LOSS, **changes)
    steady = [replace(b, table=b.table.assign(rpm=3000.0)) for b in empty_batches(air, 4)]
    shown = recorded(air, steady, seed=1)
    return {"air": fitted(air, shown), "loss": fitted(loss, shown)}


def runs_of(of: Fitted) -> list[Run]:
    return list(menu(of.machine, of.batches, ["rpm"]))


@cache
def proposal() -> Proposal:
    return next_experiment(tied())


def carried_out(plan: RunPlan, truth: Fitted, seed: int) -> Batch:
    """The plan on a machine for which a rival is true: from its own state, with the instruments' noise."""
    network = truth.problem.network
    start = np.zeros((1, 1, network.n_cells))
    for body, cells in network.bodies.items():
        start[..., cells] = plan.start_degC(body)
    shown = simulate(network, truth.values, inputs_of_plan(network, plan).refined(2), start)
    rng = np.random.default_rng(seed)
    table = {"time_s": plan.time_s, **plan.surroundings}
    table |= {n: np.append(v, v[-1]) for n, v in plan.drivers.items()}
    for k, r in enumerate(network.readings):
        table[r.channel] = shown.readings[0, 0, :, k] + r.noise * rng.standard_normal(len(plan.time_s))
    for k, e in enumerate(network.errors):
        table[e.channel] = shown.errors[0, 0, :, k] + e.noise * rng.standard_normal(len(plan.time_s))
    return Batch(truth.machine.machine, "next", pd.DataFrame(table), truth.machine.batch_channels(), simulated=True)


def lead_nats(truth: Fitted, other: Fitted, more: Sequence[Batch] = ()) -> float:
    """By how much the truth's posterior density exceeds the other's, both refitted at the noise given."""
    costs = [state_of(f.machine, [*f.batches, *more], reweight=False)[1].cost for f in (other, truth)]
    return 0.5 * (costs[0] - costs[1])


def again(run: Run, hours: float, rpm: float) -> Run:
    return replace(run, label=f"again at {rpm:g} rpm", stages=(Stage(3600.0 * hours, {"rpm": rpm}),))


def test_a_run_is_chosen_that_the_recordings_were_not() -> None:
    alternatives, chosen = tied(), proposal()
    assert chosen.separates == ("air", "loss") and chosen.tied == () and chosen.sensor is None
    assert chosen.nats >= POLICY.decisive_nats and chosen.nats_per_hour == pytest.approx(chosen.nats / chosen.hours)
    first = runs_of(alternatives["air"])[0]
    like_before = foreseen(list(alternatives.values()), [again(first, 4.0, 3000.0)]).nats[..., 0]
    by_words = chosen.table.set_index("run")["nats"]
    assert like_before.max() < 0.1 * by_words.min()  # another one at that speed tells next to nothing
    run = next(r for r in runs_of(alternatives["air"]) if r.label == chosen.label)
    both = foreseen(list(alternatives.values()), [run]).nats[..., 0]
    assert chosen.nats == pytest.approx(min(both[0, 1], both[1, 0])) and both[0, 1] > 2 * both[1, 0]
    assert list(chosen.table.columns) == list(COLUMNS) and by_words.is_monotonic_decreasing
    cool = next(w for w in by_words.index if w.startswith("a cool-down"))
    assert by_words[cool] > POLICY.decisive_nats
    # several are decisive: the shortest of them
    assert chosen.hours == chosen.table.loc[chosen.table["nats"] >= POLICY.decisive_nats, "hours"].min()
    assert chosen.sentence.startswith(f"{chosen.label.capitalize()} would distinguish air and loss: 4.0 h, ")


@pytest.mark.parametrize(("truth", "other"), [("air", "loss"), ("loss", "air")])
def test_the_run_carried_out_settles_it(tmp_path: Path, truth: str, other: str) -> None:
    alternatives, chosen = tied(), proposal()
    path = tmp_path / "next.yml"
    path.write_text(chosen.plan_text)
    batch = carried_out(load_run_plan(path, alternatives[truth].machine), alternatives[truth], seed=3)
    before = lead_nats(alternatives[truth], alternatives[other])
    after = lead_nats(alternatives[truth], alternatives[other], [batch])
    run = next(r for r in runs_of(alternatives["air"]) if r.label == chosen.label)
    told = foreseen([alternatives[truth], alternatives[other]], [run]).nats[0, 1, 0]
    assert after - before > POLICY.decisive_nats
    # linear foresight: a parameter that must move far costs less or more than its first step says
    assert 0.5 * told < after - before < 1.5 * told


@pytest.mark.parametrize(("bare", "number"), [(False, 0), (False, 4), (True, 3)])
def test_foreseen_is_the_least_squares_after_a_refit(bare: bool, number: int) -> None:
    """The same number from one dense system: data of one rival, parameters and nuisances of the other with priors."""
    alternatives = list(tied(bare).values())
    run = runs_of(alternatives[0])[number]
    truth, other = (AlternativeModel.of(f, [run], ()) for f in alternatives)
    weight = np.min([f.noise.weight for f in alternatives], axis=0)

    def left(model: AlternativeModel) -> float:
        block, spread = model.blocks[0], np.array([u.spread for u in model.problem.unknowns])
        apart = model.predicted(truth.first)[0] - truth.shown[0]
        scale = np.sqrt(weight[block.channel])
        root, q = model.fitted.state.arrow.root, block.nuisance.shape[1]
        rows = scale[:, None] * np.hstack([block.nuisance, block.jacobian * spread])
        prior = np.block([[np.eye(q), np.zeros((q, len(root)))], [np.zeros((len(root), q)), root]])
        system, aim = np.vstack([rows, prior]), np.append(scale * apart, np.zeros(len(prior)))
        return float(np.sum((aim - system @ np.linalg.lstsq(system, aim, rcond=None)[0]) ** 2))

    seen = foreseen(alternatives, [run]).nats[..., 0]
    own, count = left(truth), run.rows * sum(1 / np.max([f.noise.inflation for f in alternatives], axis=0))
    assert seen[0, 1] == pytest.approx(0.5 * (left(other) - own) / (1 + own / count), rel=1e-6)
    assert (own > 1.0) == bare  # a hot body without a sensor: no rival knows where it starts
    assert (np.diagonal(seen) == 0).all()


def test_a_rival_begins_where_the_sensors_say() -> None:
    alternatives = list(tied().values())
    model = AlternativeModel.of(alternatives[0], runs_of(alternatives[0])[:2], ())
    sensor = alternatives[0].problem.network.readings[0]
    warmer = {n: v + 1.5 for n, v in model.first.items()}
    for r in range(2):
        before, after = (-sensor.noise * model.predicted(first)[r][0] for first in (model.first, warmer))
        assert before == pytest.approx(model.first["t_shaft"][r], abs=1e-3)
        assert after - before == pytest.approx(1.5, abs=1e-3)


def test_a_new_sensor_tells_nothing_of_a_constant() -> None:
    """Its own error is one more unknown: the rows' covariance is I + offset offsetᵀ."""
    rng = np.random.default_rng(0)
    rows, offset = rng.standard_normal((7, 3)), rng.uniform(1, 2, (7, 1))
    white = with_free_offset(rows, offset)
    np.testing.assert_allclose(white.T @ white, rows.T @ np.linalg.inv(np.eye(7) + offset @ offset.T) @ rows)
    np.testing.assert_array_equal(with_free_offset(rows, 0 * offset), rows)


def test_one_more_sensor_where_no_run_tells_by_itself() -> None:
    """Heat at a body without a sensor, or half of it at each of its neighbours."""
    heat = {"law": "cabinet_heat", "parameters": {"heat": {"value": "60 W", "spread": 0.7}}}
    saddle = chain(mechanisms__hidden={**heat, "into": "saddle"})
    beside = chain(mechanisms__hidden={**heat, "into": {"column": 0.5, "bed": "rest"}})
    shown = recorded(saddle, [replace(b, table=b.table.assign(coolant=0.0)) for b in empty(5)], seed=2)
    got = next_experiment({"saddle": fitted(saddle, shown), "beside": fitted(beside, shown)})
    assert (
        got.table["nats"].max() < POLICY.negligible_nats and got.table["nats_with_sensor"].min() > POLICY.decisive_nats
    )
    assert got.sensor == "saddle" and set(got.table["sensor"]) == {"saddle"}
    assert got.label.endswith(" with one more sensor at saddle") and got.nats > POLICY.decisive_nats
    assert "# Put one more temperature sensor at saddle before.\n" in got.plan_text


def test_what_a_claim_lacks_decides_how_much_a_run_must_bring() -> None:
    alternatives, little = tied(), proposal()
    much = next_experiment(alternatives, lacking_nats={"loss": 1e6})  # no run brings it: the most per hour of machine
    taken_h = {r.label: r.hours + sum(s.seconds for s in r.before) / 3600 for r in runs_of(alternatives["air"])}
    rate = little.table["nats"] / little.table["run"].map(taken_h)
    assert much.label == little.table["run"][rate.argmax()]
    enough = next_experiment(alternatives, lacking_nats={"loss": little.table["nats"].max() - 1e-6})
    assert enough.label == little.table["run"][0]
    assert next_experiment(alternatives, lacking_nats={"loss": -3.0}).label == little.label


def unclaimed(*gains: float, accepted: bool = False) -> Search:
    """A search whose last round tried the effect of a machine, by so many nats each, in clusters of their own."""
    before, after = tied()["loss"], tied()["air"]
    part = after.part.mechanisms["spin"]
    tried = []
    for k, gain in enumerate(gains):
        c = Candidate("rotating_convection", Where("link", "shaft-room"), f"spin{k}", f"spin {k}", part)
        tried.append(Tried(Scored(c), after, gain, np.full(4, gain / 4), f"c{k}", 0.0))
    screen: Any = None
    last = Round(before, screen, tuple(tried))  # without figures nothing is claimed
    if accepted:  # t_head shows what is impossible without the first
        last = replace(last, figures=figures(before, tried), resolved=frozenset({"t_head"}))
    return Search(before, before, (last,))


def test_a_run_is_proposed_for_what_gains_too_little() -> None:
    tried = unclaimed(6.0)
    run = revealing_run(tried)
    assert run is not None and run.separates == (NOTHING, "spin 0") and run.plan_text
    lacks = tried.rounds[-1].threshold - 6.0
    alone = next_experiment({NOTHING: tied()["loss"], "spin 0": tied()["air"]}, lacking_nats={"spin 0": lacks})
    assert run.label == alone.label and run.nats == pytest.approx(alone.nats)


def test_no_run_is_proposed_where_nothing_gains_or_all_is_claimed() -> None:
    assert revealing_run(unclaimed()) is None
    assert revealing_run(unclaimed(POLICY.decisive_nats - 0.1)) is None
    assert revealing_run(unclaimed(20.0, accepted=True)) is None


def test_rivals_that_no_run_separates() -> None:
    alternatives = tied()
    same = next_experiment({"air": alternatives["air"], "twin": alternatives["air"]})
    assert (same.label, same.plan_text, same.separates, same.tied) == ("", "", (), (("air", "twin"),))
    assert same.sentence.startswith("None of 6 runs would distinguish them: the best, ")
    three = next_experiment({"air": alternatives["air"], "twin": alternatives["air"], "loss": alternatives["loss"]})
    assert three.separates == ("air", "twin", "loss") and three.tied == (("air", "twin"),)
    assert three.label == proposal().label and three.nats == pytest.approx(proposal().nats)
    assert three.sentence.endswith(" air and twin would stay tied.")
    none = next_experiment(alternatives, runs=[])
    assert none.label == "" and none.sentence.startswith("No run is known")
    with pytest.raises(ValueError, match="two alternatives or more, got 1"):
        next_experiment({"air": alternatives["air"]})
    with pytest.raises(ValueError, match="same channels"):
        next_experiment({"air": alternatives["air"], "bare": tied(bare=True)["loss"]})


@pytest.mark.parametrize(
    ("name", "hours", "step_s"), [("sample_vmc", 6, 300), ("lathe_gv1203", 6, 300), ("tclab_board", 0.25, 5)]
)
def test_plans_read_back_as_they_are(tmp_path: Path, name: str, hours: float, step_s: float) -> None:
    known = load_machine(MACHINES / f"{name}.yml")
    batches = empty_batches(known, 3, hours, step_s)
    drivers = compile_network(known).drivers
    batches = [
        replace(
            b, table=b.table.assign(**{n: np.minimum(b.table[n], 100.0) for n in drivers if n.startswith("heater")})
        )
        for b in batches
    ]
    runs = menu(known, batches, drivers, step_s)
    assert len({r.label for r in runs}) == len(runs) >= 3
    for run in runs:
        path = tmp_path / "plan.yml"
        start = {next(iter((known.twin or {})["bodies"])): 23.4} if run.surroundings else {}
        path.write_text(run.text(start, ["said above"]))
        got, want = load_run_plan(path, known), run.plan(known, start)
        assert path.read_text().startswith("# said above\n") and got.name == run.label
        np.testing.assert_allclose(got.time_s, want.time_s, atol=1e-5)
        for read, meant in ((got.drivers, want.drivers), (got.surroundings, want.surroundings)):
            assert set(read) == set(meant)
            for n in meant:
                np.testing.assert_allclose(read[n], meant[n], atol=1e-4)
        assert (got.start, got.initial_degC) == (want.start, want.initial_degC)
        assert run.hours == pytest.approx(want.time_s[-1] / 3600.0)
        assert 3.0 <= run.hours <= 10.0 or name == "tclab_board"


def test_the_menu_goes_as_far_as_the_recordings() -> None:
    known = machine()
    runs = {r.label: r for r in menu(known, empty_batches(known, 3), ["rpm"])}
    assert list(runs) == [
        "3 h at 5000 rpm and 2 h at rest",
        "a staircase of speeds up to 5000 rpm and 1 h at rest",
        "4 h at 1000 rpm",
        "a cool-down of 5 h after 4 h at 5000 rpm",
        "a night switched off",
        "8 h at rest in a hall that is heated by 5 K",
    ]
    stairs = runs["a staircase of speeds up to 5000 rpm and 1 h at rest"].plan(known).drivers["rpm"]
    assert sorted(set(stairs.tolist())) == [0.0, 1250.0, 2500.0, 3750.0, 5000.0] and stairs[-1] == 0
    night = runs["a night switched off"].plan(known).surroundings["room"]
    assert night[0] - night[-1] == pytest.approx(6.0)
    heated = runs["8 h at rest in a hall that is heated by 5 K"].plan(known).surroundings["room"]
    assert heated[18] - heated[0] == pytest.approx(5.0) and heated[6] == heated[0]  # from 0.5 to 1.5 h
    with pytest.raises(InputError, match="machine two_bodies: no recordings to take speeds and temperatures from"):
        menu(known, [], ["rpm"])


def test_without_a_spindle_and_without_a_room() -> None:
    pumped = machine(mechanisms={"heat": {"law": "cabinet_heat", "drivers": "pump", "into": "head"}})
    channels = {**pumped.channels, "pump": pumped.channels["rpm"].model_copy(update={"unit": "1"})}
    del channels["rpm"]
    pumped = pumped.model_copy(update={"channels": channels})
    switched = empty_batches(pumped, 3)
    switched = [replace(b, table=b.table.assign(pump=np.minimum(b.table["pump"], 1.0))) for b in switched]
    label = [r.label for r in menu(pumped, switched, ["pump"])]
    assert label[:2] == ["pump alone, 3 h on and 1 h off", "a cool-down of 5 h after 4 h of pump on"]
    assert len(label) == 4  # and a night and a heated hall
    board = load_machine(MACHINES / "tclab_board.yml")
    runs = menu(board, empty_batches(board, 2, 0.25, 5.0), ["heater1", "heater2"], 5.0)
    assert not any(r.surroundings for r in runs) and all(r.hours < 0.5 for r in runs)
    assert runs[0].label == "heater1 alone, 15 min at 100 % and 5 min off"
    # a driver that cannot be 0 is an outcome, such as a cell's voltage
    cell = load_machine(MACHINES / "cell_30q.yml")
    assert menu(cell, empty_batches(cell, 1, 0.25, 10.0), ["current", "voltage"], 10.0) == []


def test_a_hot_run_begins_hot() -> None:
    rival = tied()["air"]
    runs = runs_of(rival)
    cool = next(r for r in runs if r.label.startswith("a cool-down"))
    room = cool.surroundings["room"][0][1]
    hot, cold = begun(rival, cool), begun(rival, runs[0])
    assert hot["shaft"] > hot["head"] > room + 1.0
    assert cold["shaft"] == pytest.approx(room, abs=0.01)
    text = next_experiment(tied(), [cool]).plan_text
    assert f"shaft: {round(hot['shaft'], 1):g}" in text and "# Begin after 24 h at rest, then 4 h" in text
