"""Write docs/results.md, the figures of the papers beside ours, from the runs stored in benchmarks/results/quality.

python docs/make_results.py            write the page
python docs/make_results.py --check    exit with status 1 if the page is stale
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gridreg.ablation.statistics import Estimate, estimate
from gridreg.ablation.tables import signed
from gridreg.training.files import write_text

PAGE = Path(__file__).with_name("results.md")
STUDY_STORE = Path(__file__).parent.parent / "benchmarks" / "results"
STORE = STUDY_STORE / "quality"

HEAD = """# Results

Every figure on this page is computed from the files in `benchmarks/results/quality/`, one for each run, which
`benchmarks/quality.py` wrote; `python docs/make_results.py` writes the page from them. Ours are means over the test
views of the protocol and, where there are several, over seeds; ± and [ ] are 95 % intervals (Student's t) over seeds,
or over pairs of the same scene and seed. "α" marks rows that use the pictures' alpha to carve the box. A dash is a run
that has not been made. Runs with one thread ran beside another one on the same two cores.

Published figures are those of the Few TensoRF paper, whose rows for TensoRF and FreeNeRF are its own reproductions. Its
text does not say which eight views it used; its released configuration has those of `fewtensorf8`. Published baselines
scatter by 1 to 2 dB between papers, so only rows of one program under one protocol compare. The occlusion loss of the
fine-tuned row has FreeNeRF's range from the near plane, that of the raw one counts samples from the box.

"""


@dataclass(frozen=True)
class Method:
    """A row: how it is called, the run of `benchmarks/quality.py`, and what was published for it by scene."""

    name: str
    run: str
    published: dict[str, float]


SCENES = ("lego", "chair")
METHODS = (
    Method("TensoRF", "tensorf", {"lego": 23.83, "chair": 23.45}),
    Method("Few TensoRF, raw", "few_tensorf", {"lego": 25.68, "chair": 27.70}),
    Method("Few TensoRF, fine-tuned", "few_tensorf_finetuned", {"lego": 25.73, "chair": 27.71}),
    Method("Few TensoRF, masks as printed", "few_tensorf:few_tensorf_printed", {}),
    Method("FreeNeRF", "freenerf", {"lego": 24.81, "chair": 27.01}),
    Method("in the style of FourieRF", "fourierf", {}),
    Method("in the style of SANeRF", "sanerf", {}),
    Method("`quick`", "quick", {}),
    Method("`best`", "best", {}),
    Method("`best-long`", "best-long", {}),
)
BODIES = ("subject_a", "subject_b")
BODY_METHODS = (
    ("TensoRF, 50 views", "human50", "tensorf"),
    ("TensoRF, 8 views", "human8", "tensorf"),
    ("Few TensoRF, fine-tuned, 8 views", "human8", "few_tensorf_finetuned"),
    (
        "Few TensoRF, fine-tuned, 8 views, fixed ratio 0.8",
        "human8",
        "few_tensorf_finetuned:few_tensorf_fixed",
    ),
    ("`human`, 8 views", "human8", "human"),
)


class Runs:
    """The stored runs, by scene, protocol, run and seed; shortened and changed runs are left out."""

    def __init__(self, folder: Path = STORE) -> None:
        self.records: dict[tuple[str, str, str], dict[int, dict[str, Any]]] = {}
        for path in sorted(folder.glob("*.json")):
            record = json.loads(path.read_text(encoding="utf-8"))
            if "--steps" in record["command"] or record["changes"]:
                continue
            key = (record["scene"], record["protocol"], record["run"])
            self.records.setdefault(key, {})[record["seed"]] = record

    def of(self, scene: str, protocol: str, run: str) -> dict[int, dict[str, Any]]:
        """Records by seed."""
        return self.records.get((scene, protocol, run), {})

    def mean(
        self, scene: str, protocol: str, run: str, pick: Callable[[dict[str, Any]], float]
    ) -> Estimate | None:
        """Mean over seeds of a figure; None without a run."""
        found = [pick(record) for record in self.of(scene, protocol, run).values()]
        return estimate(found) if found else None

    def gains(self, scenes: Sequence[str], protocol: str, run: str, base: str) -> Estimate | None:
        """Differences of PSNR (dB) of two runs, over the pairs of scene and seed that both have."""
        pairs = []
        for scene in scenes:
            ours, theirs = self.of(scene, protocol, run), self.of(scene, protocol, base)
            pairs += [psnr(ours[seed]) - psnr(theirs[seed]) for seed in sorted(ours.keys() & theirs.keys())]
        return estimate(pairs) if pairs else None


def psnr(record: dict[str, Any]) -> float:
    """Mean PSNR, dB."""
    return float(record["mean"]["psnr"])


def ssim(record: dict[str, Any]) -> float:
    """Mean SSIM, Gaussian windows."""
    return float(record["mean"]["ssim_gaussian"])


def minutes(record: dict[str, Any]) -> float:
    """Of training."""
    return float(record["seconds"]["train"]) / 60


def threads(records: dict[int, dict[str, Any]]) -> str:
    """How many each run had."""
    return "/".join(map(str, sorted({record["versions"]["threads"] for record in records.values()})))


def with_spread(found: Estimate | None, digits: int = 2) -> str:
    """``25.10 ± 0.20 (3)``, ``25.10 (1)`` or a dash."""
    if found is None:
        return "–"
    spread = "" if found.half_width is None else f" ± {found.half_width:.{digits}f}"
    return f"{found.mean:.{digits}f}{spread} ({found.count})"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def few_shot(runs: Runs, protocol: str) -> str:
    """PSNR, SSIM and minutes of every method on every scene, published figures beside them."""
    head = ["method"]
    for scene in SCENES:
        head += [f"{scene}: PSNR (seeds)", "published", "SSIM 11x11", "training (min; threads)"]
    rows = []
    for method in METHODS:
        found = [runs.of(scene, protocol, method.run) for scene in SCENES]
        if not any(found) and protocol != "dietnerf8":
            continue
        carved = any(record["uses_alpha"] for records in found for record in records.values())
        cells = [method.name + (" α" if carved else "")]
        for scene in SCENES:
            published = method.published.get(scene)
            seen = runs.mean(scene, protocol, method.run, ssim)
            taken = runs.mean(scene, protocol, method.run, minutes)
            cells += [
                with_spread(runs.mean(scene, protocol, method.run, psnr)),
                "" if published is None else f"{published:.2f}",
                "–" if seen is None else f"{seen.mean:.3f}",
                "–"
                if taken is None
                else f"{taken.mean:.1f}; {threads(runs.of(scene, protocol, method.run))}",
            ]
        rows.append(cells)
    return table(head, rows)


def bodies(runs: Runs) -> str:
    """The human bodies."""
    rows = []
    for name, protocol, run in BODY_METHODS:
        found = [runs.mean(scene, protocol, run, psnr) for scene in BODIES]
        rows.append([name, *(with_spread(value) for value in found)])
    return table(["method", *(f"{scene}: PSNR (seeds)" for scene in BODIES)], rows)


STUDIES = (
    (
        "occlusion_near",
        "Where the occlusion loss of Few TensoRF begins",
        "Twenty samples from the ray's entry into the box, which shrinks to the object, or FreeNeRF's range from the "
        "near plane.",
    ),
    (
        "finetuned_search",
        "Changes to Few TensoRF, fine-tuned",
        "One change at a time. Without masks, or with masks that open soon, copies of the chair hang before the cameras, "
        "and it can be seen through itself (validation views r_14 and r_63); lego is blurred all over.",
    ),
    (
        "finetuned_full",
        "Changes to Few TensoRF, fine-tuned, at its full length",
        "On chair, where it misses the published figure.",
    ),
    (
        "best_leave_one_out",
        "Pieces of `best`",
        "One piece left out at a time; what a negative figure says is lost without it.",
    ),
    (
        "best_pieces",
        "Pieces of `best` as it was",
        "An earlier `best`, with masks and 2,500 iterations in full, one piece left out at a time.",
    ),
    (
        "best_more",
        "More of `best`",
        "Without masks; one change at a time, and at last iterations that cost less, which it has now.",
    ),
    (
        "human_search",
        "`best` on bodies",
        "What the preset `human` was chosen from; PSNR alone, as validation has no meshes.",
    ),
    (
        "best_rates",
        "Learning rates of `best`",
        "As it was with masks and without distortion penalty; one run a row.",
    ),
    (
        "best_search",
        "Changes to `best`",
        "As it was then, one change at a time; what did not help stayed out.",
    ),
)


def study_tables(folder: Path = STUDY_STORE) -> str:
    """PSNR of the studies' rows on each scene, and their mean difference to the baseline."""
    parts = []
    for name, title, about in STUDIES:
        records = [
            json.loads(path.read_text(encoding="utf-8")) for path in sorted((folder / name).glob("*.json"))
        ]
        if records:
            first = records[0]
            where = f"`{first['protocol']}`, {first['steps']} iterations, `examples/studies/{name}.yaml`"
            parts.append(f"\n## {title}\n\n{about} {where}.\n\n{study_table(records)}")
    return "".join(parts)


def study_table(records: Sequence[dict[str, Any]]) -> str:
    """The rows of one study: the baseline, then the others from the best difference to the worst."""
    found: dict[str, dict[tuple[str, int], float]] = {}
    for record in records:
        found.setdefault(record["label"], {})[record["scene"], record["seed"]] = psnr(record)
    scenes = sorted({record["scene"] for record in records})

    def cells(runs: dict[tuple[str, int], float]) -> list[str]:
        by_scene = ([value for (where, _), value in runs.items() if where == scene] for scene in scenes)
        return [with_spread(estimate(values) if values else None) for values in by_scene]

    base = found.pop(records[0]["baseline"], {})
    compared = []
    for label, runs in found.items():
        gains = [runs[pair] - base[pair] for pair in sorted(runs.keys() & base.keys())]
        if gains:
            mean = estimate(gains).mean
            told = [signed(mean), f"{signed(min(gains))} to {signed(max(gains))}"]
        else:
            mean, told = -math.inf, ["–", ""]
        compared.append((mean, [label, *cells(runs), *told]))
    compared.sort(key=lambda row: -row[0])
    head = ["row", *(f"{scene} (runs)" for scene in scenes), "mean difference (dB)", "least to most"]
    first = [[records[0]["baseline"], *cells(base), "", ""]] if base else []
    return table(head, [*first, *(row for _, row in compared)])


def beside_plain(folder: Path = STORE) -> str:
    """The compiled path beside the plain one, of runs that have both, by seed; nothing without any."""
    found: dict[tuple[str, str, str, int, int], dict[str, dict[str, Any]]] = {}
    for path in sorted(folder.glob("*.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        if not record["changes"]:
            key = tuple(record[name] for name in ("scene", "protocol", "run", "steps", "seed"))
            plain = "--backend" in record["command"]
            found.setdefault(key, {})["plain" if plain else "compiled"] = record
    rows, gains = [], []
    for (scene, protocol, run, steps, seed), both in sorted(found.items()):
        if len(both) == 2:
            plain, compiled = both["plain"], both["compiled"]
            gains.append(psnr(compiled) - psnr(plain))
            rows.append(
                [
                    f"`{run}`, {scene}, {protocol}, {steps} iterations", str(seed),
                    *(f"{psnr(record):.2f}" for record in (plain, compiled)), signed(gains[-1]),
                    *(f"{record['seconds']['train']:.0f}" for record in (plain, compiled)),
                ]
            )  # fmt: skip
    if not rows:
        return ""
    mean = estimate(gains)
    spread = "" if mean.half_width is None else f" [{signed(mean.low)}, {signed(mean.high)}]"
    head = ["run", "seed", "plain (dB)", "compiled (dB)", "difference", "plain (s)", "compiled (s)"]
    return (
        "\n## The compiled path beside the plain one\n\nTrained by plain PyTorch (`benchmarks/quality.py --backend "
        "torch`) and by the compiled kernels, in equal steps,\nwith one thread beside another run, and both scored by "
        "the kernels. "
        f"Mean difference: {signed(mean.mean)}{spread} dB.\n\n" + table(head, rows)
    )


def verdict(found: Estimate | None, claimed: float) -> str:
    """What our pairs say about a claimed gain, dB; the rule stands on the page."""
    if found is None:
        return "not measured"
    if found.half_width is None:
        return "one pair: no verdict"
    if found.low > 0:
        return "holds" if found.high >= claimed else "holds in sign, but is smaller"
    if found.high < 0:
        return "the opposite"
    return "within noise"


RULE = """A claimed gain *holds* if the interval of our paired differences lies above 0 and reaches the claim; it *holds
in sign* if it lies above 0 and below the claim; *the opposite* is an interval below 0; one that has 0 inside is *within
noise*.

"""


PICTURES = """
## What the pictures show


Made by `benchmarks/quality.py --keep` and `benchmarks/error_pictures.py`, and looked at; they show other people's
scenes, so they are not part of the project.

* lego, `tensorf` (r_144, 26.5 dB): the bucket's inside is too dark and flat, its rivets doubled; the grille is
  smeared. No haze, sharp outlines.
* lego, `few_tensorf` (the same view, 26.4 dB): the bucket's inside is blotched, light streaks of fog lie between
  the tracks and before the grille, a white cloud hangs under the front; in low views (r_72, r_80, r_120) a fringe
  of haze hangs below the ground plate, which no training view sees from the side. From behind and above (r_0, r_8,
  r_192) white specks lie on the ground.
* lego, `best` (the same view, 29.4 dB): no fog and no haze. What is left: edges one pixel wide, the gaps of the
  tracks and of the grille, the inner wall of the bucket, a little soft. The worst views are the low ones from the
  side (24.6 dB) and the one from behind and above (24.1 dB).
* chair, `tensorf` (r_152, 27.3 dB): closed, patterns readable, a little darker than it is. A green patch hangs above
  the chair in views from behind and above (r_0, r_168 to r_192): the rest of a wall right before a training camera.
* chair, `few_tensorf_finetuned` (the same view, 25.6 dB): no wall. White wood before the white background can be seen
  through: legs, armrests and the rim below the seat are frayed, most in views from the side (r_64 to r_80, 21.7 to
  22.6 dB). With an occlusion loss that counts 20 samples from the box, the front legs are eaten away as well.
* chair, `best` (r_64, 26.0 dB; r_152, 30.1 dB): upright, closed, patterns readable. The ornaments are blurred where
  they sit on thin wood, the shadow side of the legs is hazy, the armrest's cloth has lost its pattern, and seat and
  back are a little too bright all over: their sheen is seen from one direction by one training view.
"""


# What is claimed, on which scenes, under which protocol, of which run over which other, and how much (dB).
CLAIMS: tuple[tuple[str, tuple[str, ...], str, str, str, float], ...] = (
    (
        "Few TensoRF, raw, gains over TensoRF (lego 1.85, chair 4.25)",
        SCENES, "dietnerf8", "few_tensorf", "tensorf", 3.05,
    ),
    (
        "Few TensoRF, fine-tuned, gains over TensoRF (lego 1.90, chair 4.26)",
        SCENES, "dietnerf8", "few_tensorf_finetuned", "tensorf", 3.08,
    ),
    (
        "10,000 iterations (fine-tuned) are better than 15,000 (raw) (lego 0.05, chair 0.01)",
        SCENES, "dietnerf8", "few_tensorf_finetuned", "few_tensorf", 0.03,
    ),
    (
        "Masks in blocks gain over those printed (not published)",
        SCENES, "dietnerf8", "few_tensorf", "few_tensorf:few_tensorf_printed", 0.0,
    ),
    (
        "Bodies: TensoRF at 8 views gains over Few TensoRF with the fixed ratio (1.00 and 0.28)",
        BODIES, "human8", "tensorf", "few_tensorf_finetuned:few_tensorf_fixed", 0.64,
    ),
    (
        "`best` gains over Few TensoRF, fine-tuned, both ours",
        SCENES, "dietnerf8", "best", "few_tensorf_finetuned", 0.0,
    ),
    (
        "`human` gains over TensoRF at 8 views (our target: 1.5)",
        BODIES, "human8", "human", "tensorf", 1.5,
    ),
)  # fmt: skip


def claims(runs: Runs) -> str:
    """A verdict for every claim."""
    rows = []
    for text, scenes, protocol, run, base, claimed in CLAIMS:
        found = runs.gains(scenes, protocol, run, base)
        seen = "–"
        if found is not None:
            spread = "" if found.half_width is None else f" [{signed(found.low)}, {signed(found.high)}]"
            seen = f"{signed(found.mean)}{spread} ({found.count})"
        rows.append([text, signed(claimed) if claimed else "", seen, verdict(found, claimed)])
    return RULE + table(["claim", "published (dB)", "ours (dB; pairs)", "verdict"], rows)


def page(runs: Runs) -> str:
    """The whole page."""
    parts = [
        HEAD,
        "## Eight views, `dietnerf8`\n\n",
        few_shot(runs, "dietnerf8"),
        "\n## Eight views, `fewtensorf8`\n\nThe authors' own eight views.\n\n",
        few_shot(runs, "fewtensorf8"),
        "\n## Human bodies\n\nThe paper's own bodies are others (0525 and 0300): TensoRF 40.98 and 45.58 dB with "
        "50 views, 28.37 and 34.28 with 8; Few TensoRF with the fixed ratio 27.37 and 34.00.\n\n",
        bodies(runs),
        "\n## Claims\n\n",
        claims(runs),
        beside_plain(),
        PICTURES,
        study_tables(),
    ]
    return "".join(parts)


def main(words: Sequence[str] | None = None) -> int:
    """Write or check the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="only say whether the page is up to date")
    arguments = parser.parse_args(words)
    text = page(Runs())
    if arguments.check:
        fresh = PAGE.is_file() and PAGE.read_text(encoding="utf-8") == text
        print(f"{PAGE.name}: {'up to date' if fresh else 'stale; run python docs/make_results.py'}")
        return 0 if fresh else 1
    write_text(PAGE, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
