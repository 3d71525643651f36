"""Named protocols: which views are trained on and scored, at which size and on which background.

Figures of different protocols are not comparable: published baselines scatter by 1-2 dB between them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gridreg.errors import ConfigError
from gridreg.scenes.kmeans import greedy_plus_plus, lloyd, squared_distances

__all__ = [
    "COUNTED",
    "PROTOCOLS",
    "VALIDATION_VIEWS",
    "Every",
    "First",
    "KMeans",
    "Listed",
    "NearestToCentres",
    "Protocol",
    "Seeded",
    "Selection",
    "Spread",
    "get_protocol",
]


@dataclass(frozen=True)
class Listed:
    """Exactly these indices."""

    indices: tuple[int, ...]

    def select(self, positions: NDArray[np.float64]) -> tuple[int, ...]:
        """Return the indices; whether they exist is for the loader to say."""
        return self.indices


@dataclass(frozen=True)
class Every:
    """Every ``stride``-th frame from the first; ``Every(1)`` is all of them."""

    stride: int

    def select(self, positions: NDArray[np.float64]) -> tuple[int, ...]:
        """Return 0, stride, 2 stride, ... below the number of frames."""
        return tuple(range(0, len(positions), self.stride))


@dataclass(frozen=True)
class First:
    """The first ``count`` frames."""

    count: int

    def select(self, positions: NDArray[np.float64]) -> tuple[int, ...]:
        """Return 0 .. count - 1."""
        return tuple(range(self.count))


@dataclass(frozen=True)
class Seeded:
    """``count`` frames by NumPy's ``choice`` without replacement; a larger count extends a smaller one."""

    count: int
    seed: int = 0

    def select(self, positions: NDArray[np.float64]) -> tuple[int, ...]:
        """Return the choice; for 8 of 100 frames and seed 0 it is DietNeRF's list."""
        if self.count > len(positions):
            return tuple(range(self.count))
        # The legacy generator, because the published list came from it.
        chosen = np.random.RandomState(self.seed).choice(len(positions), self.count, replace=False)
        return tuple(int(i) for i in chosen)


@dataclass(frozen=True)
class Spread:
    """``count`` frames evenly spread over the list, first and last among them (RegNeRF on LLFF)."""

    count: int

    def select(self, positions: NDArray[np.float64]) -> tuple[int, ...]:
        """Return ``round(linspace(0, N - 1, count))``."""
        if self.count > len(positions):
            return tuple(range(self.count))
        return tuple(int(i) for i in np.round(np.linspace(0, len(positions) - 1, self.count)))


@dataclass(frozen=True)
class KMeans:
    """The frames nearest to the ``count`` k-means centres of the camera positions (ZeroRF, section 4)."""

    count: int
    seed: int = 0

    def select(self, positions: NDArray[np.float64]) -> tuple[int, ...]:
        """Return one frame per cluster, in increasing order: Lloyd's iterations from k-means++ centres."""
        if self.count > len(positions):
            return tuple(range(self.count))
        rng = np.random.default_rng(self.seed)
        centres = positions[[int(rng.integers(len(positions)))]]
        while len(centres) < self.count:
            gap = squared_distances(positions, centres).min(axis=1)
            # Cameras at one place leave nothing to spread over: any of them is as good.
            fraction = gap / gap.sum() if gap.sum() > 0 else np.full(len(gap), 1 / len(gap))
            centres = np.concatenate([centres, positions[[int(rng.choice(len(positions), p=fraction))]]])
        for _ in range(100):
            nearest = squared_distances(positions, centres).argmin(axis=1)
            moved = np.stack(
                [
                    positions[nearest == k].mean(axis=0) if (nearest == k).any() else c
                    for k, c in enumerate(centres)
                ]
            )
            if np.array_equal(moved, centres):
                break
            centres = moved
        distances = squared_distances(positions, centres)
        chosen: list[int] = []
        for k in range(self.count):
            distances[chosen, k] = np.inf
            chosen.append(int(distances[:, k].argmin()))
        return tuple(sorted(chosen))


@dataclass(frozen=True)
class NearestToCentres:
    """The frames nearest to the centres of scikit-learn's ``KMeans(count, n_init=restarts, random_state=0)``.

    The algorithm is written out, draw for draw, so that nothing needs to be installed: greedy k-means++ from
    NumPy's legacy generator, then Lloyd's iterations to scikit-learn's tolerance; of several restarts the one
    of least inertia.

    Source: SplatFields (Mihajlovic et al. 2024), program; scikit-learn 1.3 and later, ``KMeans``.
    """

    count: int
    restarts: int

    def select(self, positions: NDArray[np.float64]) -> tuple[int, ...]:
        """Return one frame per centre, in increasing order."""
        if self.count > len(positions):
            return tuple(range(self.count))
        middle = positions.mean(axis=0)
        points = positions - middle
        random = np.random.RandomState(0)
        runs = [lloyd(points, greedy_plus_plus(points, self.count, random)) for _ in range(self.restarts)]
        _, centres = min(runs, key=lambda run: run[0])
        # In the world, as the program has it: of two cameras that share a centre, rounding decides.
        distances = np.linalg.norm(positions[:, None] - (centres + middle), axis=-1)
        return tuple(sorted(int(i) for i in distances.argmin(axis=0)))


Selection = Listed | Every | First | Seeded | Spread | KMeans | NearestToCentres


@dataclass(frozen=True)
class Protocol:
    """Views, size, background and where they come from.

    Attributes:
        name: the protocol's name.
        train: selection from the training frames, by index into their list.
        test: selection from the test frames, by index into their list.
        halve_at: images of this edge, in pixels, are halved by 2x2 area means of RGBA before compositing.
        background: ``"white"`` or ``"black"``.
        source: who uses it.
        validates: the scored views are `VALIDATION_VIEWS` training frames, evenly spread over those that are
            not trained on, instead of ``test``.
        leave: position among the training views of the one that is left out and scored instead of ``test``.
        holds_out: whether frames that the reader would hold out of one list for testing are kept from training. If not,
            they are scored all the same, which tells how well the field fits them and no more.
    """

    name: str
    train: Selection
    test: Selection
    halve_at: int | None
    background: str
    source: str
    validates: bool = False
    leave: int | None = None
    holds_out: bool = True


VALIDATION_VIEWS = 10
"""Number of views that a ``-validation`` protocol scores."""

_SUFFIX = "-validation"
_DIETNERF = Listed((26, 86, 2, 55, 75, 93, 16, 73))
_GAUSSIAN = Listed((2, 16, 26, 55, 73, 76, 86, 93))
_EVERY_SIXTH = Listed((0, 6, 12, 18, 24, 30, 36, 42))

PROTOCOLS: dict[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        Protocol("dietnerf8", _DIETNERF, Every(8), 800, "white", "DietNeRF, FreeNeRF, SANeRF"),
        Protocol("gs8", _GAUSSIAN, Every(8), 800, "white", "Gaussian-splatting papers"),
        Protocol(
            "fewtensorf8", _EVERY_SIXTH, Every(8), 800, "white", "Few TensoRF, the authors' configuration"
        ),
        Protocol("zerorf4", KMeans(4), Every(1), None, "white", "ZeroRF, FourieRF"),
        Protocol("zerorf6", KMeans(6), Every(1), None, "white", "ZeroRF, FourieRF"),
        Protocol("human8", _EVERY_SIXTH, Every(1), None, "white", "Few TensoRF, human bodies, 8 views"),
        Protocol("human50", First(50), Every(1), None, "white", "Few TensoRF, human bodies, 50 views"),
        Protocol(
            "builtin8", First(8), Every(1), None, "white", "the built-in scene; not a published benchmark"
        ),
        Protocol("holdout8", Every(1), Every(1), None, "white", "own images and LLFF: every 8th held out"),
        Protocol(
            "all", Every(1), Every(1), None, "white", "own images, too few to hold any out", holds_out=False
        ),
    )
}
"""The protocols by name; :func:`get_protocol` knows the counted forms as well."""

COUNTED = {
    "views<N>": "N views by NumPy's seed-0 choice, else as dietnerf8",
    "first<N>": "the first N views, else as dietnerf8",
    "spread<N>": "N views evenly spread over the list, tested on all test views, as stored",
    "human<N>": "N views of a body, evenly spread over 48",
    "splatfields<N>": "the N views of SplatFields as scikit-learn finds them today",
    "splatfields<N>-ninit10": "the N views of SplatFields as scikit-learn found them when it was published",
    "NAME-validation": "any of these, scored on training frames that are not trained on",
    "NAME-leave<K>": "any of these without its K-th view, scored on that one",
}
"""Forms of names with a number of views N, or an ending, with what they mean."""


def get_protocol(name: str) -> Protocol:
    """Return the protocol of that name.

    Besides :data:`PROTOCOLS` there are the counted forms of :data:`COUNTED`. Those of a body count in the views of
    ``human8``; ``spread<N>`` is RegNeRF's choice of 3, 6 and 9 views of LLFF scenes; SplatFields' k-means had one
    start or, by default when it was published, ten. Settings are chosen with ``-validation``, without a look at the
    test views; `gridreg tune` chooses with ``-leave<K>``, which scores one of the views, the K-th from 0.

    Raises:
        InputError: for an unknown name.

    >>> get_protocol("views8").train.select(np.zeros((100, 3))) == get_protocol("dietnerf8").train.indices
    True
    """
    if name in PROTOCOLS:
        return PROTOCOLS[name]
    if name.endswith(_SUFFIX) and not name.removesuffix(_SUFFIX).endswith(_SUFFIX):
        whole = get_protocol(name.removesuffix(_SUFFIX))
        if whole.leave is None:
            return replace(whole, name=name, validates=True)
    left_out = re.fullmatch(r"(.+)-leave(\d{1,6})", name)
    if left_out is not None:
        whole = get_protocol(left_out[1])
        if not whole.validates and whole.leave is None:
            return replace(whole, name=name, leave=int(left_out[2]))
    counted = re.fullmatch(r"(views|first|spread|human|splatfields)([1-9]\d{0,5})(-ninit10)?", name)
    if counted is None or (counted[3] and counted[1] != "splatfields"):
        forms = [form for form in COUNTED if form[:4] != "NAME"]
        known = f"{', '.join([*PROTOCOLS, *forms])}, or one of these with -validation or -leave<K>"
        raise ConfigError(("protocol",), f"found {name!r}, expected one of {known}")
    count = int(counted[2])
    if counted[1] == "spread":
        return Protocol(name, Spread(count), Every(1), None, "white", "RegNeRF, on LLFF scenes")
    if counted[1] == "splatfields":
        chosen = NearestToCentres(count, 10 if counted[3] else 1)
        return Protocol(name, chosen, Every(1), None, "white", "SplatFields")
    if counted[1] == "human":
        views = Listed(tuple(48 * k // count for k in range(count)))
        return Protocol(name, views, Every(1), None, "white", f"a study of human bodies with {count} views")
    train: Selection = Seeded(count) if counted[1] == "views" else First(count)
    return Protocol(name, train, Every(8), 800, "white", f"a study with {count} views")
