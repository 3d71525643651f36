"""Protocols: the published lists, the counted forms and k-means."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.cluster.vq import kmeans2

from gridreg.errors import InputError
from gridreg.scenes import PROTOCOLS, get_protocol
from gridreg.scenes.protocols import Every, First, KMeans, Listed, NearestToCentres, Seeded

HUNDRED = np.zeros((100, 3))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("dietnerf8", (26, 86, 2, 55, 75, 93, 16, 73)),
        ("gs8", (2, 16, 26, 55, 73, 76, 86, 93)),
        ("fewtensorf8", (0, 6, 12, 18, 24, 30, 36, 42)),
        ("human8", (0, 6, 12, 18, 24, 30, 36, 42)),
        ("human50", tuple(range(50))),
        ("builtin8", tuple(range(8))),
    ],
)
def test_training_views(name: str, expected: tuple[int, ...]) -> None:
    assert PROTOCOLS[name].train.select(HUNDRED) == expected


@pytest.mark.parametrize("name", ["dietnerf8", "gs8", "fewtensorf8"])
def test_every_eighth_test_view_of_two_hundred(name: str) -> None:
    ids = PROTOCOLS[name].test.select(np.zeros((200, 3)))
    assert ids == tuple(range(0, 200, 8))
    assert len(ids) == 25


@pytest.mark.parametrize("name", ["zerorf4", "zerorf6", "human8", "human50", "builtin8"])
def test_all_test_views(name: str) -> None:
    assert PROTOCOLS[name].test.select(np.zeros((200, 3))) == tuple(range(200))


def test_only_the_halving_protocols_halve() -> None:
    halving = {name for name, protocol in PROTOCOLS.items() if protocol.halve_at is not None}
    assert halving == {"dietnerf8", "gs8", "fewtensorf8"}
    assert all(PROTOCOLS[name].halve_at == 800 for name in halving)
    assert all(protocol.background == "white" for protocol in PROTOCOLS.values())
    assert all(protocol.source and protocol.name == name for name, protocol in PROTOCOLS.items())


def test_seeded_choice_is_the_published_one_and_nests() -> None:
    assert get_protocol("views8").train.select(HUNDRED) == PROTOCOLS["dietnerf8"].train.select(HUNDRED)
    three, ten, all_of_them = (get_protocol(f"views{n}").train.select(HUNDRED) for n in (3, 10, 100))
    assert ten[:3] == three
    assert all_of_them[:10] == ten
    assert sorted(all_of_them) == list(range(100))


def test_first_n() -> None:
    protocol = get_protocol("first5")
    assert protocol.name == "first5"
    assert protocol.train.select(HUNDRED) == (0, 1, 2, 3, 4)
    assert protocol.halve_at == 800


@pytest.mark.parametrize(
    "name", ["nerf8", "views", "views0", "first-1", "views1.5", "", "views08", "views9999999"]
)
def test_unknown_names_list_the_known_ones(name: str) -> None:
    with pytest.raises(
        InputError, match=r"protocol: found .* expected one of dietnerf8, .* views<N>"
    ) as error:
        get_protocol(name)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("selection", [Seeded(9), KMeans(9), First(9), Listed((9,))])
def test_too_many_views_are_left_to_the_loader(selection: Seeded | KMeans | First | Listed) -> None:
    assert max(selection.select(np.zeros((5, 3)))) >= 5


@given(st.integers(1, 40), st.integers(1, 12))
def test_every_is_an_arithmetic_progression(count: int, stride: int) -> None:
    assert Every(stride).select(np.zeros((count, 3))) == tuple(k for k in range(count) if k % stride == 0)


def blobs(seed: int) -> np.ndarray:
    """Four tight groups of five cameras."""
    rng = np.random.default_rng(seed)
    centres = np.array([[4.0, 0, 0], [-4, 0, 0], [0, 4, 0], [0, 0, 4]])
    return (centres[:, None] + 0.01 * rng.standard_normal((4, 5, 3))).reshape(20, 3)


@given(st.integers(0, 10_000))
def test_kmeans_takes_the_middle_of_every_group(seed: int) -> None:
    positions = blobs(seed)
    chosen = KMeans(4).select(positions)
    assert sorted(i // 5 for i in chosen) == [0, 1, 2, 3]
    for i in chosen:
        group = positions[5 * (i // 5) : 5 * (i // 5) + 5]
        gaps = np.linalg.norm(group - group.mean(axis=0), axis=1)
        assert gaps[i % 5] == gaps.min()


@given(st.integers(1, 10), st.integers(0, 3), st.booleans())
def test_kmeans_is_repeatable_and_never_repeats_a_view(count: int, seed: int, degenerate: bool) -> None:
    positions = np.ones((12, 3)) if degenerate else np.random.default_rng(7).standard_normal((12, 3))
    chosen = KMeans(count, seed).select(positions)
    assert chosen == KMeans(count, seed).select(positions)
    assert len(set(chosen)) == count
    assert list(chosen) == sorted(chosen)


@pytest.mark.parametrize("seed", range(5))
def test_kmeans_spreads_as_well_as_scipy_does(seed: int) -> None:
    positions = np.random.default_rng(3).standard_normal((60, 3))
    positions *= 4 / np.linalg.norm(positions, axis=1, keepdims=True)

    def spread(centres: np.ndarray) -> float:
        return float(np.linalg.norm(positions[:, None] - centres, axis=-1).min(axis=1).mean())

    best = min(spread(kmeans2(positions, 6, minit="++", rng=k)[0]) for k in range(10))
    assert spread(positions[list(KMeans(6, seed).select(positions))]) < 1.25 * best


@pytest.mark.parametrize("restarts", [1, 10])
@given(st.integers(4, 12), st.integers(14, 120), st.integers(0, 2**16), st.booleans())
def test_splatfields_views_are_those_of_scikit_learn(
    restarts: int, count: int, cameras: int, seed: int, upper: bool
) -> None:
    cluster = pytest.importorskip("sklearn.cluster")
    points = np.random.default_rng(seed).normal(size=(cameras, 3))
    points *= 4 / np.linalg.norm(points, axis=1, keepdims=True)
    points[:, 2] = abs(points[:, 2]) if upper else points[:, 2]
    centres = cluster.KMeans(count, n_init=restarts, random_state=0).fit(points).cluster_centers_
    expected = sorted(int(np.linalg.norm(points - centre, axis=1).argmin()) for centre in centres)
    assert list(NearestToCentres(count, restarts).select(points)) == expected


def test_splatfields_and_human_by_name() -> None:
    assert get_protocol("splatfields6").train == NearestToCentres(6, 1)
    published = get_protocol("splatfields12-ninit10-validation")
    assert (published.train, published.validates) == (NearestToCentres(12, 10), True)
    assert published.test.select(np.zeros((200, 3))) == tuple(range(200))
    assert published.halve_at is None
    assert get_protocol("splatfields8").train.select(np.zeros((5, 3))) == tuple(range(8))
    assert get_protocol("human4").train.select(HUNDRED) == (0, 12, 24, 36)
    assert get_protocol("human6").train.select(HUNDRED) == (0, 8, 16, 24, 32, 40)
    assert get_protocol("human8-validation").train == PROTOCOLS["human8"].train
    for name in ("human0", "human8-ninit10", "splatfields", "splatfields8-ninit5"):
        with pytest.raises(InputError, match="expected one of"):
            get_protocol(name)
