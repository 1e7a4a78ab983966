"""Places of bodies in a picture: no crossings where none are needed, no overlaps, always the same."""

from __future__ import annotations

import numpy as np

from twin.views.layout import crossings, places

RING = {("a", "b"): 5.0, ("b", "c"): 1.0, ("c", "d"): 5.0, ("d", "a"): 1.0, ("a", "e"): 2.0, ("c", "f"): 30.0}
PITCH = (2.0, 1.5)


def n_crossings(at: dict[str, tuple[float, float]], links: dict[tuple[str, str], float]) -> int:
    names = list(at)
    ends = np.array([(names.index(a), names.index(b)) for a, b in links])
    return crossings(np.array([at[n] for n in names]), ends)


def test_a_ring_with_tails_has_no_crossing_and_every_body_its_own_place() -> None:
    at = places(list("abcdef"), RING, pitch=PITCH)
    xy = np.array(list(at.values()))
    apart = np.abs(xy[:, None] - xy[None])
    shares_a_row = apart[..., 1] < 1e-9
    assert n_crossings(at, RING) == 0
    assert (apart[..., 0][shares_a_row & ~np.eye(6, dtype=bool)] >= PITCH[0] - 1e-9).all()
    assert xy.min(axis=0).tolist() == [0.0, 0.0]


def test_crossings_are_counted() -> None:
    square = {"a": (0.0, 0.0), "b": (1.0, 1.0), "c": (1.0, 0.0), "d": (0.0, 1.0)}
    assert n_crossings(square, {("a", "b"): 1.0, ("c", "d"): 1.0}) == 1
    assert n_crossings(square, {("a", "c"): 1.0, ("b", "d"): 1.0}) == 0


def test_the_same_network_in_another_order_of_links_stands_at_the_same_places() -> None:
    again = dict(reversed(list(RING.items())))
    one, other = places(list("abcdef"), RING), places(list("abcdef"), again)
    for name, xy in one.items():
        np.testing.assert_allclose(other[name], xy)


def test_the_heavy_stands_low() -> None:
    links = {("light", "middle"): 1.0, ("middle", "heavy"): 1.0, ("light", "x"): 1.0, ("heavy", "y"): 1.0}
    for heavy in ("light", "heavy"):
        at = places(["light", "middle", "heavy", "x", "y"], links, {heavy: 100.0})
        assert at[heavy][1] <= np.mean([y for _, y in at.values()])


def test_few_bodies_and_none() -> None:
    assert places([], {}) == {}
    assert places(["a"], {}) == {"a": (0.0, 0.0)}
    two = places(["a", "b"], {("a", "b"): 1.0}, pitch=PITCH)
    assert abs(two["a"][0] - two["b"][0]) >= 1.0


def test_a_strong_link_is_short_and_what_has_no_link_stands_apart() -> None:
    at = places(["a", "b", "c", "d"], {("a", "b"): 100.0, ("b", "c"): 0.01, ("a", "d"): 0.01}, pitch=PITCH)

    def apart(one: str, other: str) -> float:
        return float(np.hypot(*np.subtract(at[one], at[other]) / PITCH))

    assert apart("a", "b") <= min(apart("b", "c"), apart("a", "d")) and apart("a", "b") < apart("c", "d")
    alone = places(["a", "b", "c"], {("a", "b"): 1.0}, pitch=PITCH)
    assert len(set(alone.values())) == 3
