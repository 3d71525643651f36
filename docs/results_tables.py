"""The tables of docs/results.md, from the figures stored in benchmarks/results and the rows of docs/results.yaml."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from stored import RESULTS, Record, load

from gridreg.ablation.statistics import Estimate, estimate
from gridreg.ablation.tables import signed

ROWS: Record = yaml.safe_load(Path(__file__).with_name("results.yaml").read_text(encoding="utf-8"))
SCENES, BODIES = ROWS["scenes"], ROWS["bodies"]


def psnr(record: Record) -> float:
    """Mean PSNR, dB."""
    return float(record["mean"]["psnr"])


def ssim(record: Record) -> float:
    """Mean SSIM, Gaussian windows."""
    return float(record["mean"]["ssim_gaussian"])


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def seeds_in_words(count: int) -> str:
    """Return ``3 seeds``; one seed says so in a word."""
    return "one seed" if count == 1 else f"{count} seeds"


def with_spread(found: Estimate | None) -> str:
    """Return ``25.10 ± 0.20 (3 seeds)``, ``25.10 (one seed)`` or a dash."""
    if found is None:
        return "–"
    spread = "" if found.half_width is None else f" ± {found.half_width:.2f}"
    return f"{found.mean:.2f}{spread} ({seeds_in_words(found.count)})"


def with_interval(gains: Sequence[float]) -> str:
    """Return ``−0.04 [−0.14, +0.06]``, or the mean of one pair alone."""
    found = estimate(gains)
    spread = "" if found.half_width is None else f" [{signed(found.low)}, {signed(found.high)}]"
    return f"{signed(found.mean)}{spread}"


def pairs_in_words(pairs: dict[tuple[str, int], float]) -> str:
    """Return ``6``, the number of pairs of scene and seed; one seed is said."""
    alone = len({seed for _, seed in pairs}) == 1
    return f"{len(pairs)}; one seed" if alone else str(len(pairs))


def time_taken(records: dict[int, Record]) -> str:
    """Return ``7.1; 1/2``: minutes of training, the median of the seeds, and the threads that runs had; or a dash."""
    if not records:
        return "–"
    minutes = statistics.median(record["seconds"]["train"] / 60 for record in records.values())
    threads = "/".join(map(str, sorted({record["versions"]["threads"] for record in records.values()})))
    return f"{minutes:.1f}; {threads}"


def verdict(gains: Sequence[float], claimed: float) -> str:
    """Return what our pairs say about a claimed gain, dB; the rule stands on the page."""
    if not gains:
        return "not measured"
    found = estimate(gains)
    if found.half_width is None:
        return "one pair: no verdict"
    if found.low > 0:
        return "holds" if found.high >= claimed else "holds in sign, but is smaller"
    if found.high < 0:
        return "the opposite"
    if max(gains) < 0:
        return "the opposite in every pair, too few to be sure"
    if min(gains) > 0:
        return "in sign in every pair, too few to be sure"
    return "within noise" if found.high >= claimed else "within noise, below the claim"


class Results:
    """The tables of the page, from the records of a folder.

    Runs stand by scene, protocol, run and seed; changed ones and those of the plain path are left out. A run of another
    length than its preset's is called ``RUN --steps N``.
    """

    def __init__(self, folder: Path = RESULTS) -> None:
        self.folder = folder
        self.records: dict[tuple[str, str, str], dict[int, Record]] = {}
        for record in load("quality", folder):
            if not record["changes"] and "--backend" not in record["command"]:
                length = f" --steps {record['steps']}" if "--steps" in record["command"] else ""
                key = (record["scene"], record["protocol"], record["run"] + length)
                self.records.setdefault(key, {})[record["seed"]] = record

    def of(self, scene: str, protocol: str, run: str) -> dict[int, Record]:
        """Return records by seed."""
        return self.records.get((scene, protocol, run), {})

    def mean(self, scene: str, protocol: str, run: str, pick: Callable[[Record], float]) -> Estimate | None:
        """Return the mean over seeds of a figure; None without a run."""
        found = [pick(record) for record in self.of(scene, protocol, run).values()]
        return estimate(found) if found else None

    def gains_of(
        self, scenes: Sequence[str], protocol: str, run: str, base: str, base_protocol: str | None = None
    ) -> dict[tuple[str, int], float]:
        """Return differences of PSNR (dB) of two runs, by the pairs of scene and seed that both have."""
        pairs = {}
        for scene in scenes:
            ours, theirs = self.of(scene, protocol, run), self.of(scene, base_protocol or protocol, base)
            for seed in sorted(ours.keys() & theirs.keys()):
                pairs[scene, seed] = psnr(ours[seed]) - psnr(theirs[seed])
        return pairs

    def cells(self, scene: str, protocol: str, run: str) -> list[str]:
        """Return PSNR, the published figure, SSIM and minutes of a run."""
        published = next((m.get("published", {}) for m in ROWS["methods"] if m["run"] == run), {}).get(scene)
        seen = self.mean(scene, protocol, run, ssim)
        return [
            with_spread(self.mean(scene, protocol, run, psnr)),
            "" if published is None else f"{published:.2f}",
            "–" if seen is None else f"{seen.mean:.3f}",
            time_taken(self.of(scene, protocol, run)),
        ]

    def few_shot(self, protocol: str) -> str:
        """Return PSNR, SSIM and minutes of every method on every scene, published figures beside them."""
        rows = []
        for method in ROWS["methods"]:
            found = [self.of(scene, protocol, method["run"]) for scene in SCENES]
            if any(found) or protocol == "dietnerf8":
                carved = any(record["uses_alpha"] for records in found for record in records.values())
                cells = [cell for scene in SCENES for cell in self.cells(scene, protocol, method["run"])]
                rows.append([method["name"] + " α" * carved, *cells])
        return table(["method", *heads("PSNR", "published", "SSIM 11x11", "training (min; threads)")], rows)

    def bodies(self) -> str:
        """Return PSNR on the human bodies."""
        rows = []
        for method in ROWS["body_methods"]:
            found = [self.mean(scene, method["protocol"], method["run"], psnr) for scene in BODIES]
            rows.append([method["name"], *map(with_spread, found)])
        return table(["method", *(f"{scene}: PSNR" for scene in BODIES)], rows)

    def claims(self) -> str:
        """Return a verdict for every claim."""
        rows = []
        for claim in ROWS["claims"]:
            base = (claim["base"], claim.get("base_protocol"))
            pairs = self.gains_of(ROWS[claim["over"]], claim["protocol"], claim["run"], *base)
            gains, claimed = list(pairs.values()), claim.get("claimed", 0.0)
            seen = f"{with_interval(gains)} ({pairs_in_words(pairs)})" if gains else "–"
            rows.append([claim["text"], signed(claimed) if claimed else "", seen, verdict(gains, claimed)])
        return table(["claim", "published (dB)", "ours (dB; pairs)", "verdict"], rows)

    def targets(self) -> str:
        """Return what was aimed at, and whether the mean of the seeds is there."""
        rows = []
        for target in ROWS["targets"]:
            for scene, least in target["least"].items():
                found = self.mean(scene, target["protocol"], target["run"], psnr)
                reached = "–" if found is None else "yes" if found.mean >= least else "no"
                rows.append([f"`{target['run']}`, {scene}", f"{least:.1f}", with_spread(found), reached])
        return table(["run", "target (dB)", "ours (dB)", "reached"], rows)

    def gains(self) -> str:
        """Return gains over plain TensoRF, of pairs of the same views and seed."""
        places = [(p, scene) for p in ("dietnerf8", "fewtensorf8") for scene in SCENES]
        places += [("human8", scene) for scene in BODIES]
        rows = []
        for run in ROWS["gains"]:
            found = [self.gains_of([scene], protocol, run, "tensorf") for protocol, scene in places]
            means = [
                f"{signed(statistics.fmean(g.values()))} ({seeds_in_words(len(g))})" if g else "–"
                for g in found
            ]
            rows += [[f"`{run}`", *means]] if any(found) else []
        return table(["gain over `tensorf` (dB)", *(f"{scene}, `{p}`" for p, scene in places)], rows)

    def ensembles(self) -> str:
        """Return seeds joined beside the seeds alone."""
        rows = []
        for record in load("ensembles", self.folder):
            alone = [psnr(member) for member in record["members"]]
            rows.append(
                [
                    f"`{record['run']}`, {record['scene']}",
                    ", ".join(f"{value:.2f}" for value in alone),
                    f"{psnr(record):.2f}",
                    signed(psnr(record) - statistics.fmean(alone)),
                    f"{ssim(record):.3f}",
                ]
            )
        return table(
            ["runs", "seeds alone (dB)", "joined (dB)", "gain over their mean (dB)", "SSIM 11x11"], rows
        )

    def deviations(self) -> str:
        """Return whether the deviation of several seeds tells where they are wrong."""
        rows = []
        for one in load("deviations", self.folder):
            found = sorted(one["object_pixels"].values())
            span = f"{statistics.fmean(found):.2f} ({found[0]:.2f} to {found[-1]:.2f})"
            rows.append(
                [f"`{one['run']}`, {one['scene']}, {one['members']} seeds", span, f"{one['views']:.2f}"]
            )
        return table(["runs", "pixels of the object, mean (range) over views", "views"], rows)

    def beside_plain(self) -> str:
        """Return the mean difference (dB) of the compiled path to the plain one, of runs that have both."""
        found: dict[tuple[Any, ...], dict[bool, float]] = {}
        for record in load("quality", self.folder):
            if not record["changes"]:
                key = tuple(record[name] for name in ("scene", "protocol", "run", "steps", "seed"))
                found.setdefault(key, {})["--backend" in record["command"]] = psnr(record)
        gains = [both[False] - both[True] for both in found.values() if len(both) == 2]
        return f"{with_interval(gains)} dB ({len(gains)} pairs)" if gains else "not measured"

    def times(self) -> str:
        """Return seconds of training of whole runs with nothing beside them, by preset and processor."""
        found: dict[tuple[str, str], dict[str, list[tuple[float, str]]]] = {}
        for record in load("speed", self.folder):
            wanted = {"command": "schedule", "seed": 0, "threads": 2}
            given = record["arguments"]
            if all(record[key] == value for key, value in wanted.items()) and not (
                given["set"] or given["steps"]
            ):
                seconds, stolen = record["seconds"]["train"], record.get("stolen")
                text = f"{seconds:.0f}" + ("" if stolen is None else f" ({stolen:.0%} stolen)")
                times = found.setdefault((record["preset"], record["versions"]["cpu"]), {})
                times.setdefault(record["scene"], []).append((seconds, text))
        rows = []
        for (preset, cpu), times in sorted(found.items()):
            cells = (
                "; ".join(text for _, text in sorted(times.get(scene, [(0.0, "–")]))) for scene in SCENES
            )
            rows.append([f"`{preset}`, {cpu}", *cells])
        return table(["alone on two cores: training (s)", *SCENES], rows)

    def remedies(self, helped: bool) -> str:
        """Return the remedies that gained in every pair, or those that did not, the greatest gain first."""
        found = []
        for remedy in ROWS["remedies"]:
            records = load(remedy["study"], self.folder)
            pairs = study_gains(records, remedy["row"], -1 if remedy.get("left_out") else 1)
            if not pairs or helped != (min(pairs.values()) > 0):
                continue
            mean, kept = statistics.fmean(pairs.values()), "yes" if remedy.get("kept") else ""
            spread = (
                f"{signed(min(pairs.values()))} to {signed(max(pairs.values()))}" if len(pairs) > 1 else ""
            )
            steps = next(record["steps"] for record in records if record["label"] == remedy["row"])
            cells = [remedy["name"], f"{signed(mean)} ({pairs_in_words(pairs)})", spread, kept]
            found.append((mean, [*cells, f"`{remedy['study']}`, {steps:,}"]))
        rows = [row for _, row in sorted(found, key=lambda item: -item[0])]
        return table(["remedy", "gain (dB; pairs)", "least to most", "in `best`", "study, iterations"], rows)

    def front(self) -> str:
        """Return the table of README.md: a few runs under `dietnerf8`, published figures beside them."""
        rows = []
        for run in ROWS["front"]:
            found = [self.cells(scene, "dietnerf8", run) for scene in SCENES]
            rows.append([f"`{run}`", *(cell for cells in found for cell in (*cells[:2], cells[3]))])
        return table(["run", *heads("PSNR", "published", "minutes; threads")], rows)


def heads(first: str, *others: str) -> list[str]:
    """Return heads of the columns of each scene, the first of which names it."""
    return [head for scene in SCENES for head in (f"{scene}: {first}", *others)]


def study_gains(records: Sequence[Record], label: str, sign: int = 1) -> dict[tuple[str, int], float]:
    """Return differences of PSNR (dB) of a study's row to its baseline, by the pairs of scene and seed of both."""
    found: dict[str, dict[tuple[str, int], float]] = {}
    for record in records:
        found.setdefault(record["label"], {})[record["scene"], record["seed"]] = psnr(record)
    row, base = (found.get(name, {}) for name in (label, records[0]["baseline"] if records else ""))
    return {pair: sign * (row[pair] - base[pair]) for pair in sorted(row.keys() & base.keys())}
