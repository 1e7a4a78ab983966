import re

import numpy as np
import pytest
from toy_problems import ToyProblem, decay, linear, unknowns

import twin.calibration.arrow
from data.errors import InputError, WorkError
from twin.calibration.arrow import assemble
from twin.calibration.fit_problem import Block
from twin.calibration.identifiability import intervals90
from twin.calibration.least_squares import FitOptions, Unknown, fit


def linear_problem(seed: int = 0, rows: tuple[int, ...] = (40, 25, 3)) -> ToyProblem:
    """Three batches with 2, 0 and 3 nuisances, 4 parameters of unequal spread; the last batch has few rows."""
    rng = np.random.default_rng(seed)
    designs = [rng.normal(size=(n, 4)) for n in rows]
    given = tuple(Unknown(f"p{i}", "K", 0.3 * i, 0.5 + i, scale="linear") for i in range(4))
    nuisance = [rng.normal(size=(n, q)) for n, q in zip(rows, (2, 0, 3), strict=True)]
    measured = [d @ [1.0, -2.0, 0.5, 3.0] + rng.normal(size=len(d)) for d in designs]
    return ToyProblem(given, measured, linear(designs), nuisance)


def dense_solution(problem: ToyProblem) -> tuple[np.ndarray, np.ndarray]:
    """The whole system at once: parameters and nuisances stacked, and their covariance."""
    p, sizes = len(problem.unknowns), problem.nuisance_sizes
    starts = p + np.concatenate([[0], np.cumsum(sizes)])
    rows = [np.zeros((0, starts[-1]))]
    for b, design in enumerate(problem.nuisance_design):
        row = np.zeros((len(design), starts[-1]))
        row[:, :p] = problem.model(np.zeros(p), b)[1]
        row[:, starts[b] : starts[b + 1]] = design
        rows.append(row)
    a, y = np.vstack(rows), np.concatenate(problem.measured)
    precision = np.concatenate([[u.spread**-2 for u in problem.unknowns], np.ones(sum(sizes))])
    mean = np.concatenate([[u.prior for u in problem.unknowns], np.zeros(sum(sizes))])
    covariance = np.linalg.inv(a.T @ a + np.diag(precision))
    return covariance @ (a.T @ y + precision * mean), covariance


@pytest.mark.parametrize("gram_limit", [1e9, 0.0], ids=["cholesky", "householder"])
def test_linear_gaussian_equals_the_dense_closed_form(gram_limit, monkeypatch):
    monkeypatch.setattr(twin.calibration.arrow, "GRAM_LIMIT", gram_limit)
    problem = linear_problem()
    solution, covariance = dense_solution(problem)
    found = fit(problem)
    np.testing.assert_allclose(found.x, solution[:4], rtol=1e-10)
    np.testing.assert_allclose(np.concatenate(found.nuisance), solution[4:], rtol=1e-10)
    np.testing.assert_allclose(found.covariance, covariance[:4, :4], rtol=1e-10)
    precision = np.concatenate([[u.spread**-2 for u in problem.unknowns], np.ones(5)])
    assert found.dof == pytest.approx(68 - (9 - np.sum(precision * np.diag(covariance))), rel=1e-10)
    assert found.converged and found.message == "converged after 1 step"


def test_cost_is_the_sum_of_residuals_and_priors():
    problem = linear_problem(rows=(20, 25, 3))
    found = fit(problem)
    residual = np.concatenate(problem.residuals(found.x, found.nuisance))
    z = [(x - u.prior) / u.spread for x, u in zip(found.x, problem.unknowns, strict=True)]
    expected = residual @ residual + np.dot(z, z) + sum(v @ v for v in found.nuisance)
    assert found.cost == pytest.approx(expected, rel=1e-12)


def test_wide_priors_and_near_collinear_columns_keep_the_undetermined_direction_exact():
    # Spread 1e6 and a pair of equal columns: in x only their sum is known, the difference keeps the prior's sd.
    column = np.random.default_rng(1).normal(size=(200, 1))
    given = tuple(Unknown(f"p{i}", "K", 0.0, 1e6, scale="linear") for i in range(2))
    found = fit(ToyProblem(given, [3 * column[:, 0]], linear([np.hstack([column, column])])))
    assert found.x.sum() == pytest.approx(3.0, rel=1e-9)
    difference = np.array([1.0, -1.0]) @ found.covariance @ [1.0, -1.0]
    assert difference == pytest.approx(2e12, rel=1e-6)


TIMES_S = np.linspace(0, 4.0, 25)


def decay_problem(seed: int = 0, truth: tuple[float, float] = (0.7, -0.4), sd: float = 0.02) -> ToyProblem:
    model = decay(TIMES_S, sd)
    rng = np.random.default_rng(seed)
    offset = np.ones((len(TIMES_S), 1))
    measured = [
        model(np.array(truth), b)[0] + rng.normal() * offset[:, 0] + rng.normal(size=len(TIMES_S)) for b in range(3)
    ]
    return ToyProblem(unknowns(2), measured, model, [offset] * 3)


def test_the_optimum_is_stationary():
    problem = decay_problem()
    found = fit(problem, FitOptions(tolerance=1e-14))
    assert [s.cost for s in found.history] == sorted((s.cost for s in found.history), reverse=True)
    gradient = found.x.copy()  # the prior has mean 0 and spread 1
    for b, (residual, nuisance) in enumerate(
        zip(problem.residuals(found.x, found.nuisance), found.nuisance, strict=True)
    ):
        gradient -= problem.model(found.x, b)[1].T @ residual
        np.testing.assert_allclose(problem.nuisance_design[b].T @ residual, nuisance, atol=1e-8)
    np.testing.assert_allclose(gradient, 0, atol=1e-4)


def test_intervals_cover_the_truth():
    rng = np.random.default_rng(5)
    inside, repetitions = 0, 250
    for repetition in range(repetitions):
        truth = rng.normal(size=2) * 0.5
        problem = decay_problem(seed=1000 + repetition, truth=tuple(truth), sd=0.1)
        problem.unknowns = unknowns(2, 0.5)
        for i, t in zip(intervals90(fit(problem), problem.unknowns), truth, strict=True):
            inside += i.low <= np.exp(t) <= i.high
    assert 0.87 <= inside / (2 * repetitions) <= 0.93


def test_a_bound_is_kept_and_told():
    rng = np.random.default_rng(2)
    design = rng.normal(size=(50, 2)) @ [[1.0, 0.8], [0.0, 0.6]]
    given = (Unknown("p0", "K", 0.0, 1.0, -5, 1.0, "linear"), Unknown("p1", "K", 0.0, 1.0, scale="linear"))
    measured = design @ [3.0, 1.0]
    found = fit(ToyProblem(given, [measured], linear([design])))
    assert found.at_bound == ("p0",) and found.message.endswith("; at its bound: p0")
    assert found.x[0] == 1.0 and found.converged
    # The other parameter is at its optimum given the bound.
    column = design[:, 1]
    assert found.x[1] == pytest.approx(column @ (measured - design[:, 0]) / (column @ column + 1), rel=1e-10)


def two_optima(x, b):
    """A double well: x = −1 fits, x = 1 fits worse."""
    rows = np.array([5 * (x[0] ** 2 - 1), 0.8 * (x[0] - 0.5)])
    return rows, np.array([[10 * x[0]], [0.8]])


def double_well(measured: list[float]) -> ToyProblem:
    given = (Unknown("p0", "K", 0.3, 2.0, scale="linear"),)
    return ToyProblem(given, [np.array(measured)], two_optima)


def test_more_starts_find_the_better_optimum():
    problem = double_well([0.0, -1.2])
    assert fit(problem).x[0] == pytest.approx(1, abs=0.05)
    best = fit(problem, FitOptions(starts=6, seed=1))
    assert best.x[0] == pytest.approx(-1, abs=0.05)
    reached = int(re.search(r"; (\d) of 6 starts reached this optimum \(cost within 0\.1 %\)", best.message).group(1))
    assert 1 <= reached <= 5
    again = fit(problem, FitOptions(starts=6, seed=1))
    assert again.message == best.message and again.x[0] == best.x[0]


def test_two_optima_of_equal_cost_are_told():
    given = (Unknown("p0", "K", 0.0, 2.0, scale="linear"),)

    def model(x, b):
        return np.array([5 * (x[0] ** 2 - 1)]), np.array([[10 * x[0]]])

    problem = ToyProblem(given, [np.zeros(1)], model)
    assert "ended elsewhere at the same cost, so the recordings do not distinguish them" in (
        fit(problem, FitOptions(starts=8, seed=0)).message
    )


def test_one_start_says_nothing_of_starts():
    assert "start" not in fit(decay_problem()).message


def test_an_overshooting_step_is_damped():
    # arctan: Newton's first step from 3 goes to −7 and away; the prior is wide.
    def model(x, b):
        return 10 * np.arctan(x), np.array([[10 / (1 + x[0] ** 2)]])

    found = fit(ToyProblem((Unknown("p0", "K", 3.0, 100.0, scale="linear"),), [np.zeros(1)], model))
    assert found.converged and abs(found.x[0]) < 0.01
    assert sum(s.rejected for s in found.history) >= 1


@pytest.mark.parametrize("fails", ["nan", "raises"])
def test_a_step_into_a_failing_simulation_is_rejected(fails):
    def model(x, b):
        if x[0] > 1.5:
            if fails == "raises":
                raise WorkError("the simulation diverges")
            return np.full(1, np.nan), np.full((1, 1), np.nan)
        return 20 * np.exp(-x), np.array([[-20 * np.exp(-x[0]) / 3]])  # too small by 3: every full step leaps

    given = (Unknown("p0", "K", 0.9, 5.0, scale="linear"),)
    found = fit(ToyProblem(given, [20 * np.exp([-1.2])], model))
    assert found.history[0].rejected >= 1
    assert found.x[0] == pytest.approx(1.2, abs=0.02)


def test_a_start_that_is_not_finite_names_batch_and_rows():
    def model(x, b):
        return np.full(4, np.nan if b == 1 else 0.0), np.ones((4, 2))

    problem = ToyProblem(unknowns(2), [np.zeros(4)] * 2, model)
    with pytest.raises(WorkError) as error:
        fit(problem)
    assert str(error.value) == (
        "calibration: the model fails at the prior's mean: batch 'b1': 4 of 4 modelled rows are not finite"
    )


def test_a_derivative_that_is_not_finite_names_its_parameter():
    def model(x, b):
        return np.zeros(4), np.column_stack([np.ones(4), np.full(4, np.inf)])

    with pytest.raises(WorkError, match=r"batch 'b0': the derivative by 'p1' is not finite$"):
        fit(ToyProblem(unknowns(2), [np.zeros(4)], model))


def test_further_starts_that_fail_are_counted():
    def model(x, b):
        return (np.full(3, np.nan) if abs(x[0]) > 0.5 else np.full(3, x[0])), np.ones((3, 1))

    found = fit(ToyProblem(unknowns(1), [np.zeros(3)], model), FitOptions(starts=6, seed=0))
    draws = np.random.default_rng(0).standard_normal((6, 1))[1:, 0]
    assert found.message.endswith(f"; {np.count_nonzero(np.abs(draws) > 0.5)} could not be simulated")


def test_a_wrong_derivative_is_not_called_converged():
    def model(x, b):
        return np.array([10 * (x[0] - 1), 3 * (x[0] + 1)]), np.array([[-10.0], [3.0]])

    found = fit(ToyProblem((Unknown("p0", "K", 0.0, 1.0, scale="linear"),), [np.zeros(2)], model))
    assert not found.converged
    assert "no step lowers the cost, though the linear model expects" in found.message


def test_a_model_with_noise_of_its_own_converges_as_far_as_it_is_smooth():
    def model(x, b):
        rows = np.array([10 * np.exp(x[0]), 3 * x[0]])
        return np.round(rows, 2), np.array([[10 * np.exp(x[0])], [3.0]])

    found = fit(ToyProblem((Unknown("p0", "K", 0.0, 1.0, scale="linear"),), [np.array([7.0, 0.1])], model))
    assert found.converged
    assert re.match(r"converged after \d+ steps? as far as the model is smooth", found.message)


def test_derivatives_a_little_off_are_told_in_standard_deviations():
    def model(x, b):  # coarser than its derivative says: no step lowers the cost though 0.01 to 0.1 is expected
        rows = np.array([10 * np.exp(x[0]), 3 * x[0]])
        return np.round(rows / 0.4) * 0.4, np.array([[10 * np.exp(x[0])], [3.0]])

    found = fit(ToyProblem((Unknown("p0", "K", 0.0, 1.0, scale="linear"),), [np.array([7.0, 0.1])], model))
    assert found.converged
    told = re.search(r"as far as the derivatives are exact, to (0\.\d+) posterior standard deviations", found.message)
    assert told and 0.03 < float(told[1]) < 0.32


def test_a_bound_that_rounding_misses_is_still_told():
    given = tuple(Unknown(f"p{i}", "K", 0.1 * i, 0.3, -0.07 * i - 0.1, 0.37 + 0.11 * i, "linear") for i in range(8))
    found = fit(ToyProblem(given, [np.tile([50.0, -50.0], 4)], linear([np.eye(8)])))
    assert found.at_bound == tuple(u.name for u in given) and found.converged


def test_too_few_steps_are_told():
    def model(x, b):  # a long curved valley
        return 10 * np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), 10 * np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])

    given = tuple(Unknown(f"p{i}", "K", v, 50.0, scale="linear") for i, v in enumerate([-1.2, 1.0]))
    problem = ToyProblem(given, [np.zeros(2)], model)
    short = fit(problem, FitOptions(max_iterations=4))
    assert not short.converged
    assert re.fullmatch(r"stopped after 4 steps, cost still falling by [\d.e+-]+ % a step", short.message)
    whole = fit(problem)
    assert whole.converged
    np.testing.assert_allclose(whole.x, [1, 1], atol=1e-3)


def test_fewer_rows_than_parameters():
    rng = np.random.default_rng(0)
    problem = ToyProblem(unknowns(45), [np.zeros(31)], linear([rng.normal(size=(31, 45))]))
    with pytest.raises(InputError) as error:
        fit(problem)
    assert str(error.value) == (
        "calibration: 31 usable rows for 45 free parameters; "
        "give more batches or channels, or make parameters fixed in the machine file"
    )


def test_nothing_free():
    with pytest.raises(InputError, match="no parameter is free; give at least one a prior spread"):
        fit(ToyProblem((), [np.zeros(3)], linear([np.zeros((3, 0))])))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"prior": np.nan}, "parameter 'p': its prior is nan, expected a finite number"),
        ({"spread": 0.0}, "its prior spread is 0, expected a finite number above 0"),
        ({"spread": np.inf}, "its prior spread is inf"),
        ({"low": 0.5}, "its value 1 W lies outside its bounds 1.64872 … inf; widen the bounds or correct the value"),
    ],
)
def test_an_unknown_is_checked(change, words):
    with pytest.raises(InputError, match=re.escape(words)):
        Unknown(**({"name": "p", "unit": "W", "prior": 0.0, "spread": 1.0} | change))


def ar1(rng: np.random.Generator, rows: int, memory: float) -> np.ndarray:
    shock = rng.normal(size=rows) * np.sqrt(1 - memory**2)
    out = np.empty(rows)
    out[0] = rng.normal()
    for t in range(1, rows):
        out[t] = memory * out[t - 1] + shock[t]
    return out


def two_channel_problem(second: list[np.ndarray], seed: int = 3) -> ToyProblem:
    rng = np.random.default_rng(seed)
    rows = len(second[0])
    time = np.linspace(0, 1, rows)
    channel = [np.repeat([0, 1], rows)] * len(second)
    design = [np.tile(np.column_stack([np.ones(rows), time]), (2, 1))] * len(second)
    measured = [d @ [0.4, -0.2] + np.concatenate([rng.normal(size=rows), s]) for d, s in
                zip(design, second, strict=True)]  # fmt: skip
    return ToyProblem(unknowns(2), measured, linear(design), [], channel, ("bed", "head"))


def test_white_noise_is_not_inflated():
    rng = np.random.default_rng(7)
    found = fit(two_channel_problem([rng.normal(size=1500) for _ in range(4)]), FitOptions(reweight=True))
    assert np.all((found.inflation >= 0.95) & (found.inflation <= 1.1))
    assert np.all((found.noise_factor >= 1.0) & (found.noise_factor <= 1.05))
    assert "; noise converged in round" in found.message


def test_correlated_noise_widens_its_channel_alone():
    rng = np.random.default_rng(8)
    memory = 0.9
    found = fit(two_channel_problem([3 * ar1(rng, 3000, memory) for _ in range(6)]), FitOptions(reweight=True))
    assert found.inflation[1] == pytest.approx((1 + memory) / (1 - memory), rel=0.15)
    assert found.noise_factor[1] == pytest.approx(3.0, rel=0.05)
    assert found.inflation[0] < 1.1 and found.noise_factor[0] < 1.05


def test_a_smooth_misfit_of_one_channel_no_longer_bends_the_parameters():
    rng = np.random.default_rng(0)
    time = np.linspace(0, 1, 2000)
    problem = two_channel_problem([rng.normal(size=2000) + 30 * np.sin(9 * time + k) for k in range(6)])
    truth = np.array([0.4, -0.2])
    as_given, weighed = fit(problem), fit(problem, FitOptions(reweight=True))
    assert np.abs((as_given.x - truth) / np.sqrt(np.diag(as_given.covariance))).max() > 5
    assert np.abs((weighed.x - truth) / np.sqrt(np.diag(weighed.covariance))).max() < 2
    assert weighed.inflation[1] > 100 and weighed.inflation[0] < 1.1


def test_intervals_cover_under_correlated_noise_only_with_reweighting():
    rng = np.random.default_rng(11)
    rows, repetitions = 400, 150
    time = np.linspace(0, 1, rows)
    design = np.column_stack([np.ones(rows), time])
    given = tuple(Unknown(f"p{i}", "K", 0.0, 3.0, scale="linear") for i in range(2))
    inside = {False: 0, True: 0}
    for _ in range(repetitions):
        truth = rng.normal(size=2)
        problem = ToyProblem(given, [design @ truth + ar1(rng, rows, 0.8) for _ in range(3)], linear([design] * 3))
        for reweight in inside:
            found = fit(problem, FitOptions(reweight=reweight))
            inside[reweight] += sum(i.low <= t <= i.high for i, t in zip(intervals90(found, given), truth, strict=True))
    assert inside[False] / (2 * repetitions) < 0.6
    assert 0.85 <= inside[True] / (2 * repetitions) <= 0.95


def test_progress_is_told_per_start():
    said: list[str] = []
    fit(decay_problem(), FitOptions(starts=2), progress=said.append)
    assert [s.split(":")[0] for s in said] == ["start 1 of 2", "start 2 of 2"]


def test_a_converged_fit_linearises_once_per_step():
    problem = decay_problem()
    found = fit(problem)
    assert problem.linearised == len(found.history) + 1


def test_a_smooth_misfit_at_the_priors_does_not_pass_for_noise():
    times = np.linspace(0.0, 3.0, 120)

    def model(x, b):  # 30 exp(x0) (1 - exp(-t / exp(x1))), whitened by 0.1
        warm = np.exp(-times / np.exp(x[1]))
        rows = 300 * np.exp(x[0]) * (1 - warm)
        return rows, np.column_stack([rows, -300 * np.exp(x[0]) * warm * times / np.exp(x[1])])

    truth = np.array([0.9, -1.0])  # about two prior standard deviations away
    wave = 3 * np.sin(4 * times)  # and the model is not quite right
    measured = model(truth, 0)[0] + wave + np.random.default_rng(3).normal(size=len(times))
    given = tuple(Unknown(f"p{i}", "K", 0.0, 0.45, scale="linear") for i in range(2))
    found = fit(ToyProblem(given, [measured], model), FitOptions(reweight=True))
    assert found.converged
    np.testing.assert_allclose(found.x, truth, atol=0.02)


@pytest.mark.parametrize("damping", [0.0, 1.0, 1e4, 1e10])
@pytest.mark.parametrize("share", [1.0, 0.3, 1e-6])
def test_a_step_falls_by_what_it_promises_however_little_of_the_nuisances_moves(damping: float, share: float) -> None:
    rng = np.random.default_rng(5)
    blocks = [
        Block(f"b{k}", 30 * rng.standard_normal(20), rng.standard_normal((20, 3)), np.zeros((20, 2)), np.zeros(20, int))
        for k in range(2)
    ]
    for block in blocks:  # nuisances that a parameter imitates, far from their optimum
        block.nuisance[:] = block.jacobian[:, :2] + 0.05 * rng.standard_normal((20, 2))
    nuisance, z = [np.array([40.0, -30.0]), np.array([-20.0, 50.0])], np.zeros(3)
    arrow, free = assemble(blocks, nuisance, z, unknowns(3), np.ones(1)), np.full(3, np.inf)

    def cost(dz: np.ndarray, moves: list[np.ndarray]) -> float:
        left = [b.residual - b.jacobian @ dz - b.nuisance @ m for b, m in zip(blocks, moves, strict=True)]
        prior = float(dz @ dz) + sum(float((n + m) @ (n + m)) for n, m in zip(nuisance, moves, strict=True))
        return prior + sum(float(r @ r) for r in left)

    dz = arrow.step(damping, -free, free)
    fall = cost(z, [np.zeros(2)] * 2) - cost(dz, [c.step(dz, share) for c in arrow.corners])
    assert fall > 0
    assert arrow.gain(dz, share) == pytest.approx(fall, rel=1e-3, abs=1e-6 * cost(z, [np.zeros(2)] * 2))
