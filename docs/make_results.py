"""Write docs/results.md and the tables in README.md from the runs stored in benchmarks/results.

python docs/make_results.py            write both
python docs/make_results.py --check    exit with status 1 if one is stale
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from results_claims import claims, targets
from results_remedies import remedies
from results_runs import (
    ENSEMBLE_STORE,
    STORE,
    STUDY_STORE,
    Runs,
    least_to_most,
    psnr,
    records_in,
    ssim,
    study_gains,
    table,
    time_taken,
    with_interval,
    with_spread,
)
from results_text import (
    BODIES,
    BODY_METHODS,
    ENSEMBLES,
    FRONT,
    GAINS,
    HEAD,
    METHODS,
    PICTURES,
    SCENES,
    STUDIES,
)

from gridreg.ablation.statistics import estimate
from gridreg.ablation.tables import signed
from gridreg.training.files import write_text

PAGE = Path(__file__).with_name("results.md")
README = PAGE.parents[1] / "README.md"
BEGIN, END = "<!-- results: begin -->", "<!-- results: end -->"


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
            cells += [
                with_spread(runs.mean(scene, protocol, method.run, psnr)),
                "" if published is None else f"{published:.2f}",
                "–" if seen is None else f"{seen.mean:.3f}",
                time_taken(runs.of(scene, protocol, method.run)),
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


def study_tables(folder: Path = STUDY_STORE) -> str:
    """PSNR of the studies' rows on each scene, and their mean difference to the baseline."""
    parts = []
    for name, title, about in STUDIES:
        records = records_in(folder / name)
        if records:
            first = records[0]
            steps = sorted({record["steps"] for record in records})
            length = " to ".join(str(count) for count in dict.fromkeys((steps[0], steps[-1])))
            where = f"`{first['protocol']}`, {length} iterations, `examples/studies/{name}.yaml`"
            parts.append(f"\n## {title}\n\n{about} {where}.\n\n{study_table(records)}")
    return "".join(parts)


def study_table(records: Sequence[dict[str, Any]]) -> str:
    """The rows of one study: the baseline, then the others from the best difference to the worst."""
    labels = sorted({record["label"] for record in records})
    scenes = sorted({record["scene"] for record in records})
    baseline = records[0]["baseline"]

    def cells(label: str) -> list[str]:
        runs = [record for record in records if record["label"] == label]
        by_scene = ([psnr(record) for record in runs if record["scene"] == scene] for scene in scenes)
        return [with_spread(estimate(values) if values else None) for values in by_scene]

    compared = []
    for label in (label for label in labels if label != baseline):
        gains = study_gains(records, label)
        if gains:
            mean = estimate(gains).mean
            told = [signed(mean), least_to_most(gains)]
        else:
            mean, told = -math.inf, ["–", ""]
        compared.append((mean, [label, *cells(label), *told]))
    compared.sort(key=lambda row: (-row[0], row[1]))
    head = ["row", *(f"{scene} (runs)" for scene in scenes), "mean difference (dB)", "least to most"]
    first = [[baseline, *cells(baseline), "", ""]] if baseline in labels else []
    return table(head, [*first, *(row for _, row in compared)])


def ensembles(folder: Path = ENSEMBLE_STORE) -> str:
    """Seeds joined beside the seeds alone; nothing without any."""
    rows = []
    for record in records_in(folder):
        alone = [psnr(member) for member in record["members"]]
        rows.append(
            [
                f"`{record['run']}`, {record['scene']}, {record['protocol']}",
                ", ".join(str(member["seed"]) for member in record["members"]),
                ", ".join(f"{value:.2f}" for value in alone),
                f"{psnr(record):.2f}", signed(psnr(record) - sum(alone) / len(alone)), f"{ssim(record):.3f}",
            ]
        )  # fmt: skip
    if not rows:
        return ""
    head = ["runs", "seeds", "each alone (dB)", "joined (dB)", "gain over their mean (dB)", "SSIM 11x11"]
    return "\n## Several seeds as one\n\n" + ENSEMBLES + table(head, rows)


def beside_plain(folder: Path = STORE) -> str:
    """The compiled path beside the plain one, of runs that have both, by seed; nothing without any."""
    found: dict[tuple[str, str, str, int, int], dict[str, dict[str, Any]]] = {}
    for record in records_in(folder):
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
    head = ["run", "seed", "plain (dB)", "compiled (dB)", "difference", "plain (s)", "compiled (s)"]
    return (
        "\n## The compiled path beside the plain one\n\nTrained by plain PyTorch (`benchmarks/quality.py --backend "
        "torch`) and by the compiled kernels, in equal steps,\nwith one thread beside another run, and both scored by "
        "the kernels; `quick` drew with replacement then. "
        f"Mean difference: {with_interval(estimate(gains))} dB.\n\n" + table(head, rows)
    )


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
        "\n## Targets\n\n",
        targets(runs),
        "\n## Claims\n\n",
        claims(runs),
        ensembles(),
        beside_plain(),
        PICTURES,
        remedies(),
        study_tables(),
    ]
    return "".join(parts)


def front_table(runs: Runs, ensemble_store: Path = ENSEMBLE_STORE) -> str:
    """What README.md shows: PSNR, SSIM and minutes of some runs under `dietnerf8`, and the seeds joined."""
    rows = []
    for run, about in FRONT:
        cells = []
        for scene in SCENES:
            seen = runs.mean(scene, "dietnerf8", run, ssim)
            if seen is None:
                cells.append("–")
                continue
            quality = with_spread(runs.mean(scene, "dietnerf8", run, psnr))
            cells.append(f"{quality} / {seen.mean:.3f} / {time_taken(runs.of(scene, 'dietnerf8', run))}")
        rows.append([f"`{run}`{about}", *cells])
    joined: dict[str, dict[str, dict[str, Any]]] = {}
    for record in records_in(ensemble_store):
        if record["protocol"] == "dietnerf8":
            name = f"{len(record['members'])} seeds of `{record['run']}` joined"
            joined.setdefault(name, {})[record["scene"]] = record
    for name, found in joined.items():
        cells = [
            f"{psnr(found[scene]):.2f} / {ssim(found[scene]):.3f}" if scene in found else "–"
            for scene in SCENES
        ]
        rows.append([name, *cells])
    return table(["run", *(f"{scene}: PSNR (seeds) / SSIM / minutes; threads" for scene in SCENES)], rows)


def front_gains(runs: Runs) -> str:
    """What README.md shows besides: gains over plain TensoRF, of pairs of the same views and seed."""
    places = [("dietnerf8", scene) for scene in SCENES] + [("fewtensorf8", scene) for scene in SCENES]
    places += [("human8", scene) for scene in BODIES]
    rows = []
    for run in GAINS:
        gains = [runs.gains([scene], protocol, run, "tensorf") for protocol, scene in places]
        if any(gains):
            rows.append(
                [f"`{run}`", *(f"{signed(estimate(g).mean)} ({len(g)})" if g else "–" for g in gains)]
            )
    head = ["gain over `tensorf`, dB (pairs)", *(f"{scene}, `{protocol}`" for protocol, scene in places)]
    return table(head, rows)


def front_times(store: Path = STUDY_STORE / "speed") -> str:
    """What README.md shows of whole runs with nothing beside them: seconds of training, by preset and processor."""
    found: dict[tuple[str, str], dict[str, list[tuple[float, str]]]] = {}
    for preset in ("best", "best-long"):
        for record in records_in(store, f"schedule-*-{preset}-seed0-2threads*.json"):
            stolen = record.get("stolen")
            share = "" if stolen is None else f" ({stolen:.0%} stolen)"
            times = found.setdefault((preset, record["versions"]["cpu"]), {}).setdefault(record["scene"], [])
            seconds = record["seconds"]["train"]
            times.append((seconds, f"{seconds:.0f}{share}"))
    rows = [
        [
            f"`{preset}`, {cpu}",
            *("; ".join(text for _, text in sorted(times.get(scene, [(0.0, "–")]))) for scene in SCENES),
        ]
        for (preset, cpu), times in sorted(found.items())
    ]
    return table(["alone on two cores: training (s)", *SCENES], rows)


def with_front(readme: str, runs: Runs) -> str:
    """README.md with its tables renewed, between the marks around them."""
    before, begin, rest = readme.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"README.md: found no table between {BEGIN!r} and {END!r}")
    return f"{before}{begin}\n{front_table(runs)}\n{front_gains(runs)}\n{front_times()}{end}{after}"


def main(words: Sequence[str] | None = None) -> int:
    """Write or check the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="only say whether the page is up to date")
    arguments = parser.parse_args(words)
    runs = Runs()
    told = README.read_text(encoding="utf-8")
    written = {PAGE: page(runs), README: with_front(told, runs)}
    if arguments.check:
        stale = [path.name for path, text in written.items() if path.read_text(encoding="utf-8") != text]
        print(f"{', '.join(stale)}: stale; run python docs/make_results.py" if stale else "up to date")
        return 1 if stale else 0
    for path, text in written.items():
        write_text(path, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
