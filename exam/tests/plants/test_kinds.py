"""Plants of other kinds: the engine against closed solutions, cases of every kind, their files, keys and sizes."""

from __future__ import annotations

import numpy as np
import pytest

from data.checks import check_machine, checked
from data.errors import InputError
from diagnosis.screening.screen import limits, proposed, screen
from tests.diagnosis.small_cases import fitted
from thermodrift_exam.plants.kinds import KINDS, draw_kind_case, effects_of, execute, unlisted_of
from thermodrift_exam.plants.kinds.case import KindPosed, all_effects, made, posed, variants
from thermodrift_exam.plants.kinds.effects.base import lagged
from thermodrift_exam.plants.kinds.engine import Mesh, Solid, integrate
from thermodrift_exam.plants.kinds.simulation import noise_of, on_rows, rows_of, shown, simulated
from thermodrift_exam.plants.plant import Case
from twin.calibration.estimate import CalibrationOptions, calibrate
from twin.compile import compile_network
from twin.schema import twin_part

KIND_NAMES = tuple(KINDS)
SWEPT = [pytest.param(k, marks=[] if k in ("lathe", "board") else pytest.mark.slow) for k in KIND_NAMES]


def bar(cells: int, cooled_W_per_K: float = 0.0) -> Solid:
    """A steel bar of 0.5 m, 10 cm² in section, insulated but for its end."""
    mesh = Mesh()
    mesh.box("bar", "steel", (0.5, 0.05, 0.02), (cells, 1, 1))
    mesh.film("bar", "room", cooled_W_per_K / 1e-3, ("x+",))
    return mesh.solid()


def test_a_cosine_in_an_insulated_bar_decays_as_fourier_says() -> None:
    cells = 40
    solid = bar(cells)
    x = (np.arange(cells) + 0.5) / cells
    start = 20.0 + 10.0 * np.cos(np.pi * x)[:, None]
    seen, _ = integrate(solid, lambda k, stage, t: np.zeros_like(t), start, 20.0, 300, np.eye(cells))
    diffusivity = 45.0 / (7850.0 * 465.0)
    expected = 10.0 * np.cos(np.pi * x) * np.exp(-diffusivity * (np.pi / 0.5) ** 2 * 6000.0)
    assert np.abs(seen[-1, :, 0] - 20.0 - expected).max() < 0.01


def test_a_bar_heated_at_one_end_settles_at_a_straight_line_and_keeps_its_energy() -> None:
    cells, watts, film = 20, 30.0, 2.0
    solid = bar(cells, film)
    watch = np.vstack([np.eye(cells), solid.capacity_J_per_K])

    def heat(step: int, stage: int, cells_degC: np.ndarray) -> np.ndarray:
        out = solid.film_heat_W(cells_degC, {"room": np.full(1, 20.0)})
        out[0] += watts
        return out

    seen, last = integrate(solid, heat, np.full((cells, 1), 20.0), 60.0, 6000, watch)
    length_m = 0.5 / cells
    at_end = 20.0 + watts / film
    line = at_end + watts / (45.0 * 1e-3) * length_m * (cells - 1 - np.arange(cells))
    assert np.allclose(last[:, 0], line, atol=1e-4)
    stored_J = seen[:, cells, 0]
    lost_W = film * (seen[:, cells - 1, 0] - 20.0)
    lost_J = np.r_[0.0, np.cumsum(60.0 * (lost_W[1:] + lost_W[:-1]) / 2)]
    balance = stored_J - stored_J[0] + lost_J - watts * 60.0 * np.arange(len(stored_J))
    assert np.abs(balance).max() < 2e-3 * watts * 60.0 * len(stored_J)


def test_the_method_is_of_second_order_for_heat_that_its_matrix_does_not_know() -> None:
    solid = bar(4, 2.0)

    def ends(steps: int) -> float:
        def heat(step: int, stage: int, t: np.ndarray) -> np.ndarray:
            out = solid.film_heat_W(t, {"room": np.full(1, 20.0)})
            out[0] += 40.0 * np.sin((step + stage) * 4000.0 / steps / 900.0) - 1e-3 * (t[0] - 20.0) ** 3
            return out

        return float(integrate(solid, heat, np.full((4, 1), 20.0), 4000.0 / steps, steps, np.eye(4))[1][0, 0])

    exact = ends(6400)
    assert 3.3 < (ends(100) - exact) / (ends(200) - exact) < 4.7


def test_a_lag_is_exact_for_a_ramp() -> None:
    time_s = np.arange(0.0, 3000.0, 20.0)[:, None]
    after = np.clip(time_s - 1000.0, 0.0, None)
    expected = 0.01 * (after - 200.0 * (1.0 - np.exp(-after / 200.0)))
    assert np.allclose(lagged(0.01 * after, 20.0, 200.0), expected, atol=1e-9)


def names_of(case: Case) -> dict[str, set[str]]:
    part = twin_part(case.machine)
    ends = {"-".join(reversed(k.split("-"))) for k in part.links}
    return {
        "node": {*part.bodies, *part.surroundings, *part.mechanisms},
        "link": {*part.links, *part.exposures, *ends},
        "sensor": set(part.sensors),
        "error": set(part.errors),
    }


@pytest.mark.parametrize("kind", SWEPT)
def test_a_clean_case_compiles_and_its_rows_are_whole(kind: str) -> None:
    case = draw_kind_case(5, kind, runs=2)
    compile_network(case.machine)
    assert case.truth["terms"] == [] and case.machine.simulated and all(b.simulated for b in case.batches)
    for batch in case.batches:
        assert np.isfinite(batch.table.to_numpy(float)).all()
        assert batch.names("driver") and len(batch.names("temperature")) >= 2


@pytest.mark.parametrize("kind", SWEPT)
def test_all_effects_have_places_that_the_file_names(kind: str) -> None:
    of = KINDS[kind]
    for seed in (1, 2):
        for key, item in {**of.listed, **of.unlisted}.items():
            plant = of.draw(seed, frozenset({key}))
            effect = made(key, item, plant, seed)
            places = {
                "node": {*plant.bodies, *plant.airs},
                "link": set(effect.place.split("-")) if set(effect.place.split("-")) & {*plant.bodies} else set(),
                "sensor": {s.channel for s in plant.sensors},
                "error": set(plant.errors),
            }[effect.kind]
            at = set(effect.place.split("-")) if effect.kind == "link" else {effect.place}
            assert at <= places, (key, effect.place)
    assert len(effects_of(kind)) >= 8 and len(unlisted_of(kind)) >= 2


@pytest.mark.parametrize(
    ("kind", "wanted"),
    [
        ("lathe", {"cabinet_heat": 6.0, "speed_shift": 3.0}),
        ("board", {"missing_link": 8.0}),
        pytest.param("horizontal", {"joint_conductance": 5.0}, marks=pytest.mark.slow),
        ("gantry", {"bending": 4.0, "sensor_drift": 2.0}),
        pytest.param("bench", {"cable_heat": 10.0}, marks=pytest.mark.slow),
        ("battery", {"tab_heat": 5.0, "unlisted_warm_current": 5.0}),
    ],
)
def test_an_effect_is_as_visible_as_is_wanted_and_the_key_names_it(kind: str, wanted: dict[str, float]) -> None:
    case = draw_kind_case(7, kind, wanted, runs=4)
    names = names_of(case)
    for term in case.truth["terms"]:
        assert term["sigma"] == pytest.approx(wanted[term["effect"]], rel=0.25)
        assert term["where"]["name"] in names[term["where"]["kind"]]
        assert term["active"] == "always" or {w[0] for w in term["active"]} <= {b.batch_id for b in case.batches}
    assert case.truth["effect"] == "+".join(wanted)


def at_steps(at: KindPosed, step_s: float) -> dict[str, np.ndarray]:
    course = simulated(at.plant, at.runs, all_effects(at), variants(at)[:1], step_s)
    true = shown(at.plant, course, all_effects(at), variants(at)[0].tolist(), 0)
    rows = [on_rows(course, true, {}, b, rows_of(r, at.plant.setting.row_s)) for b, r in enumerate(at.runs)]
    return {n: np.concatenate([r[n] for r in rows]) for n in true}


@pytest.mark.parametrize("kind", [pytest.param(k, marks=[] if k == "board" else pytest.mark.slow) for k in KIND_NAMES])
def test_half_the_step_gives_the_same_within_the_noise(kind: str) -> None:
    key = "radiation" if "radiation" in effects_of(kind) else "natural_convection"
    at = posed(21, kind, {key: 10.0}, runs=2)
    step_s = at.plant.setting.solver_s
    coarse, fine = at_steps(at, step_s), at_steps(at, step_s / 2)
    for name in coarse:
        rms = float(np.sqrt(np.mean((coarse[name] - fine[name]) ** 2)))
        assert rms < 0.1 * noise_of(at.plant, name), name


def test_the_same_seed_gives_the_same_case_and_an_effect_changes_nothing_else_of_the_file() -> None:
    one, other = (draw_kind_case(3, "lathe", {"hydraulic_unit": 4.0}, decoys=True, runs=3) for _ in range(2))
    assert one.truth == other.truth and one.machine == other.machine
    assert all(a.table.equals(b.table) for a, b in zip(one.batches, other.batches, strict=True))
    clean = draw_kind_case(3, "lathe", decoys=True, runs=3)
    assert clean.machine == one.machine
    assert not any(a.table.equals(b.table) for a, b in zip(one.batches, clean.batches, strict=True))


def test_what_is_withheld_is_not_in_the_file() -> None:
    clean, less = draw_kind_case(4, "lathe", runs=2), draw_kind_case(4, "lathe", {"motor_loss": 5.0}, runs=2)
    assert clean.machine.twin and less.machine.twin
    assert set(clean.machine.twin["mechanisms"]) - set(less.machine.twin["mechanisms"]) == {"motor_loss"}
    path = draw_kind_case(4, "lathe", {"spindle_growth": 5.0}, runs=2).machine.twin
    assert path and len(path["errors"]["z"]["chain"]) < len(clean.machine.twin["errors"]["z"]["chain"])


def test_decoys_are_recorded_and_in_no_term() -> None:
    case = draw_kind_case(11, "bench", decoys=True, runs=4)
    idle = set(case.machine.names("driver")) - {"spindle_rpm", "current"}
    assert idle and case.truth["terms"] == []
    assert any(case.batches[k].values(n).any() for n in idle for k in range(4))


@pytest.mark.parametrize(("kind", "seed"), [("board", 3), ("battery", 0)])
def test_a_clean_case_calibrates_to_a_few_times_its_noise(kind: str, seed: int) -> None:
    case = draw_kind_case(seed, kind)
    every_s = float(case.batches[0].time_s[-1]) / 50.0
    done = calibrate(case.machine, case.batches, CalibrationOptions(every_s=every_s, reweight=False))
    assert case.machine.twin
    by_channel = done.rms.groupby("channel")[["before", "fitted"]].mean()
    sensors = {k: float(s["noise"].split()[0]) for k, s in case.machine.twin["sensors"].items()}
    ratio = np.array([by_channel.loc[k, "fitted"] / sd for k, sd in sensors.items()])
    assert np.median(ratio) < 4.0
    assert by_channel["fitted"].sum() < 0.4 * by_channel["before"].sum()


PLAN = """# Begin after 6 h at rest, then 1 h spindle_rpm 2000.
# Put one more temperature sensor at turret before.
name: staircase
stages:
- {minutes: 30, spindle_rpm: 1000}
- {minutes: 30, spindle_rpm: 2000, coolant: 1}
surroundings: {room: [[0, 20], [1, 21]]}
"""


def test_a_plan_is_run_on_the_same_machine() -> None:
    plain = draw_kind_case(2, "lathe", {"cabinet_heat": 5.0}, runs=2)
    done = execute(2, {"cabinet_heat": 5.0}, PLAN, "lathe", runs=2)
    before, after = plain.batches[-1].start, done.batch.start
    assert done.batch.machine == plain.machine.machine and before is not None and after is not None and after > before
    assert done.batch.time_s[-1] == pytest.approx(3600.0)
    assert set(done.batch.values("spindle_rpm")) == {1000.0, 2000.0}
    assert abs(done.batch.values("room").mean() - 20.5) < 0.3
    assert "t_turret" in done.machine.channels
    compile_network(done.machine)


def test_a_heat_acts_on_the_planned_run_too() -> None:
    with_heat, without = (execute(2, e, PLAN, "lathe", runs=2) for e in ({"cabinet_heat": 20.0}, {}))
    warmer = {
        n: float((with_heat.batch.values(n) - without.batch.values(n)).mean())
        for n in with_heat.batch.names("temperature")
    }
    assert max(warmer.values()) > 0.3


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"seed": 1, "kind": "late"}, "unknown kind 'late'"),
        ({"seed": -1, "kind": "lathe"}, "seed"),
        ({"seed": 1, "kind": "lathe", "effects": {"cabinet": 3.0}}, "unknown effect 'cabinet'"),
        ({"seed": 1, "kind": "lathe", "effects": {"cabinet_heat": 0.0}}, "sigma of cabinet_heat"),
        ({"seed": 1, "kind": "lathe", "runs": 1}, "runs"),
        ({"seed": 1, "kind": "board", "effects": {"missing_link": 5.0, "wrong_link": 5.0}}, "touches nothing"),
    ],
)
def test_bad_input_gives_one_line(arguments: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=says) as raised:
        draw_kind_case(**arguments)  # type: ignore[arg-type]
    assert "\n" not in str(raised.value)


def test_contacts_share_out_their_conductance_and_conduct_both_ways() -> None:
    mesh = Mesh()
    mesh.box("low", "steel", (0.4, 0.2, 0.1), (4, 2, 1))
    mesh.box("high", "cast_iron", (0.2, 0.2, 0.1), (2, 1, 1), (0.1, 0.0, 0.1))
    mesh.contact(mesh.patch("low", "z+", 0.2, 0.8), mesh.patch("high", "z-"), 50.0)
    solid = mesh.solid()
    between = solid.laplacian_W_per_K[np.ix_(solid.blocks["low"], solid.blocks["high"])]
    assert between.sum() == pytest.approx(-50.0)
    assert np.allclose(solid.laplacian_W_per_K, solid.laplacian_W_per_K.T)
    assert np.allclose(solid.laplacian_W_per_K.sum(axis=1), 0.0)


def test_sizes_of_two_seeds_differ_widely() -> None:
    """Domain randomisation: capacities of one body over seeds spread by a factor of two and more."""
    drawn = [KINDS["lathe"].draw(seed, frozenset()) for seed in range(12)]
    heavy = [float(p.solid.capacity_J_per_K[p.bodies["motor"]].sum()) for p in drawn]
    assert max(heavy) > 2.0 * min(heavy)
    assert len({frozenset(p.bodies) for p in drawn}) > 3


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_no_row_of_a_sound_plant_is_masked(kind: str) -> None:
    case = draw_kind_case(1, kind, {}, runs=8)
    known = check_machine([checked(b, case.machine) for b in case.batches], case.machine)
    assert [f.message for b in known for f in b.findings if f.masks] == []


@pytest.mark.parametrize(("driver", "expected"), [("1", "W"), ("%", "W/%")])
def test_a_heat_per_unit_of_its_driver_says_so(driver: str, expected: str) -> None:
    """Of a heater in per cent plain watts would be off by a hundred; waste heat may follow a driver or none."""
    case = draw_kind_case(3, "board", {}, runs=4)
    heaters = {n: case.machine.channels[n].model_copy(update={"unit": driver}) for n in case.machine.names("driver")}
    known = case.machine.model_copy(update={"channels": {**case.machine.channels, **heaters}})
    done = fitted(known, case.batches)
    heats = [c for c in proposed(done) if c.mechanism in ("electrical_heat", "cabinet_heat")]
    units = limits(done, screen(done, heats), 25.0).groupby("mechanism")["unit"].agg(set)
    assert units.to_dict() == {"electrical_heat": {expected}, "cabinet_heat": {"W", expected}}
