"""The table of docs/results.md that says at a glance what each remedy gave, from the stored studies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from results_runs import STUDY_STORE, least_to_most, records_in, study_gains, table

from gridreg.ablation.statistics import estimate
from gridreg.ablation.tables import signed

REMEDIES = """
## Remedies at a glance

What each of them gave where it was tried, as differences of PSNR over the pairs of scene and seed that its study has;
their rows follow further down. Most are of one seed, and two runs that differ in the seed alone are a few tenths
apart, on lego more than on chair: what lies within that is not told from nothing. Masks by site, with `quick`, are in
the [report on ablations](ablation-report.md).

"""


@dataclass(frozen=True)
class Remedy:
    """A remedy and where it was tried: the study's row that has it, or the one that leaves it out."""

    name: str
    study: str
    row: str
    left_out: bool = False
    kept: bool = False


ALL = (
    Remedy("visual hull of the alpha as a start", "best_each", "no carving", left_out=True, kept=True),
    Remedy("total variation", "best_each", "no total variation", left_out=True, kept=True),
    Remedy("faster learning than TensoRF's", "best_each", "slower learning as in TensoRF", left_out=True, kept=True),
    Remedy("random backgrounds, in expectation", "best_each", "white background", left_out=True, kept=True),
    Remedy("every pixel once before any again", "best_each", "pixels with replacement", left_out=True, kept=True),
    Remedy("distortion", "best_each", "no distortion", left_out=True, kept=True),
    Remedy("occlusion loss, weak", "best_each", "no occlusion loss", left_out=True, kept=True),
    Remedy("L1 of density", "best_each", "no L1", left_out=True, kept=True),
    Remedy("mean of the last fifth", "best_each", "no mean of the last fifth", left_out=True, kept=True),
    Remedy("occlusion, distortion, L1, mean together", "best_each", "no small pieces", left_out=True, kept=True),
    Remedy("pools and faint gradients, for time", "best_each", "no pools and all gradients", left_out=True, kept=True),
    Remedy("backgrounds in expectation, not drawn", "best_background", "backgrounds in expectation", kept=True),
    Remedy("48 colour components, not 24", "best_components", "24 components of appearance", left_out=True, kept=True),
    Remedy("colour that depends on the direction", "best_views", "no direction", left_out=True, kept=True),
    Remedy("masks on density and appearance", "best_pieces", "no masks", left_out=True),
    Remedy("occlusion loss, by distance (Few TensoRF)", "occlusion_near", "0.625 from the near plane"),
    Remedy("occlusion loss, 20 samples from the box (Few TensoRF)", "occlusion_near", "20 samples from the box"),
    Remedy("occlusion loss ten times as strong", "best_more", "occlusion loss 0.01"),
    Remedy("distortion three times as strong", "best_full", "distortion 0.01"),
    Remedy("total variation twice as strong", "best_full", "total variation 0.006"),
    Remedy("low-pass", "best_more", "low-pass"),
    Remedy("spatial annealing", "best_others", "spatial annealing"),
    Remedy("masks on the direction: raw numbers alone", "best_views", "direction without octaves"),
    Remedy("dropout of the direction", "best_views", "dropout of the direction"),
    Remedy("dropout of components", "best_more", "dropout"),
    Remedy("entropy of opacity", "best_others", "opacity entropy 0.001"),
    Remedy("entropy along rays", "best_others", "ray entropy 0.001"),
    Remedy("weight decay", "best_others", "weight decay 0.01"),
    Remedy("earlier resampling", "best_others", "earlier resampling"),
    Remedy("later resampling", "best_others", "later resampling"),
    Remedy("learning rates are not reset", "best_others", "rates are not reset"),
    Remedy("half as many components again", "best_more", "24 and 72 components"),
    Remedy("a coarser last grid, 200^3", "best_more", "to 200 cubed"),
    Remedy("half the step along the ray", "best_more", "half the step"),
    Remedy("steps of 1.5 cells", "best_faster", "steps of 1.5 cells"),
    Remedy("hidden layers of 64", "best_faster", "hidden layers of 64"),
    Remedy("spherical harmonics", "best_cells", "spherical harmonics"),
    Remedy("stopping early: 2,300 iterations for 3,000", "best_shorter", "2,300 iterations"),
    Remedy("smooth depth in unseen views", "best_unseen", "depth smoothness as in RegNeRF"),
    Remedy("like neighbours in unseen views (InfoNeRF)", "best_unseen", "divergence of neighbours"),
    Remedy("annealed space along the ray (RegNeRF)", "best_unseen", "space annealing"),
    Remedy("gradients scaled by distance", "best_unseen", "gradients by distance"),
)  # fmt: skip


def remedies(folder: Path = STUDY_STORE) -> str:
    """Every remedy from the greatest gain to the greatest loss; nothing without a study."""
    studies = {study: records_in(folder / study) for study in sorted({remedy.study for remedy in ALL})}
    found = []
    for remedy in ALL:
        records = studies[remedy.study]
        gains = study_gains(records, remedy.row) if records else []
        if gains:
            gains = [-gain for gain in gains] if remedy.left_out else gains
            mean = estimate(gains).mean
            spread = least_to_most(gains) if len(gains) > 1 else ""
            steps = next(record["steps"] for record in records if record["label"] == remedy.row)
            study = f"`{remedy.study}`, {steps:,}"
            row = [remedy.name, f"{signed(mean)} ({len(gains)})", spread, "yes" if remedy.kept else "", study]
            found.append((mean, row))
    if not found:
        return ""
    found.sort(key=lambda item: -item[0])
    head = ["remedy", "gain (dB; pairs)", "least to most", "in `best`", "study, iterations"]
    return REMEDIES + table(head, [row for _, row in found])
