"""Pieces of a report that are text: findings, the sortable table, what failed, and where the figures come from."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from gridreg.ablation.comparison import Row, Section
from gridreg.ablation.differences import tone
from gridreg.ablation.records import RunResult, Study
from gridreg.ablation.statistics import Estimate
from gridreg.ablation.tables import LEGEND, difference_text, duration, mean_text, notes_of, signed
from gridreg.errors import InputError
from gridreg.scenes.protocols import get_protocol

__all__ = ["escaped", "failures", "findings", "provenance", "sortable_table", "wipe"]

_HEADS = ("composition", "PSNR (dB)", "Δ PSNR (dB)", "SSIM (Gaussian)", "training", "runs", "notes")
_VERSIONS = ("gridreg", "torch", "numpy", "numba", "python")
_MACHINE = ("cpu", "instructions", "cores", "threads")


def escaped(text: object) -> str:
    """Text as HTML, in elements and in attributes."""
    return html.escape(str(text), quote=True)


def findings(section: Section) -> str:
    """What the differences say, in up to four lines."""
    groups: dict[str, list[str]] = {"higher": [], "lower": [], "within noise": [], "not told": []}
    for row in section.rows:
        if row.is_baseline:
            continue
        outcome = row.outcome
        if outcome in ("higher", "lower") and row.difference and row.difference.estimate:
            groups[outcome].append(f"{escaped(row.name)} ({signed(row.difference.estimate.mean)} dB)")
        elif outcome == "within noise" or outcome.endswith("uncorrected"):
            remark = "" if outcome == "within noise" else " (a finding by itself, not among so many rows)"
            groups["within noise"].append(escaped(row.name) + remark)
        else:
            groups["not told"].append(f"{escaped(row.name)} ({outcome})")
    titles = {
        "higher": "better",
        "lower": "worse",
        "within noise": "within noise",
        "not told": "cannot be told",
    }
    lines = [
        f'<li class="{tone(key)}"><b>{titles[key]}</b> {", ".join(names)}</li>'
        for key, names in groups.items()
        if names
    ]
    return f'<ul class="findings">{"".join(lines)}</ul>' if lines else ""


def sortable_table(section: Section) -> str:
    """The table of a section; its headings are buttons that sort."""
    heads = "".join(
        f'<th scope="col">{head if head == "notes" else f"<button type=button>{head}</button>"}</th>'
        for head in _HEADS
    )
    body = "".join(_table_row(row) for row in section.rows)
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="Table of compositions"><table class="sortable">'
        f"<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>"
        f'<p class="note">{escaped(LEGEND)}</p>'
    )


def _table_row(row: Row) -> str:
    difference = row.difference.estimate if row.difference else None
    text = difference_text(row)
    if difference is not None:
        figures, _, sign = text.rpartition(" ")
        text = f'{figures} <span class="sign">{sign}</span>'
    runs = f"{row.done}" if row.done == row.expected else f"{row.done} of {row.expected}"
    zero = Estimate(0.0, None, 1) if row.is_baseline else None
    cells = (
        _cell(mean_text(row.metrics.get("psnr")), row.metrics.get("psnr")),
        _cell("baseline" if row.is_baseline else text, difference or zero, tone(row.outcome)),
        _cell(mean_text(row.metrics.get("ssim_gaussian"), 3), row.metrics.get("ssim_gaussian")),
        _cell(duration(row.seconds.mean) if row.seconds else "–", row.seconds),
        f'<td data-value="{row.done}">{runs}</td>',
        f'<td class="notes">{escaped(", ".join(notes_of(row)))}</td>',
    )
    kind = ' class="base"' if row.is_baseline else ""
    name = escaped(row.name)
    return f'<tr{kind}><th scope="row" data-value="{name}">{name}</th>{"".join(cells)}</tr>'


def _cell(text: str, value: Estimate | None, css: str = "") -> str:
    number = "" if value is None or not math.isfinite(value.mean) else repr(value.mean)
    return f'<td{f" class={css}" if css else ""} data-value="{number}">{text}</td>'


def wipe(index: int, section: Section, data: Sequence[Mapping[str, Any]]) -> str:
    """The slider between two renders; its pictures are in the page's data under the section's index."""
    if not data:
        return ""
    names = [image["name"] for image in data[0]["images"]]
    baseline = next((row.name for row in section.rows if row.is_baseline and row.name in names), names[0])
    others = [row for row in section.rows if row.name in names and not row.is_baseline and row.difference]
    found = {
        row.name: row.difference.estimate.mean for row in others if row.difference and row.difference.estimate
    }
    other = max(found, key=lambda name: found[name], default=names[-1])
    choices = "".join(
        f'<label>{label}<select name="{name}"></select></label>'
        for name, label in (
            ("scene", "scene"),
            ("view", "test view"),
            ("left", "left of the line"),
            ("right", "right"),
        )
    )
    return (
        f'<h3>Look</h3><div class="wipe" data-section="{index}" data-left="{escaped(baseline)}" '
        f'data-right="{escaped(other)}">'
        '<div class="stage"><img class="under" alt=""><img class="top" alt=""><div class="line"></div>'
        '<span class="tag left"></span><span class="tag right"></span>'
        '<input type="range" name="at" min="0" max="100" value="50" step="1" '
        'aria-label="Where the two pictures meet, percent">'
        f'</div><div><div class="choices">{choices}<button type="button">swap</button></div>'
        '<p class="note">Drag the line, or use the arrow keys. Seed <span class="seed"></span>. Pictures are at most '
        "400 pixels wide, some as JPEG; scores are those of the full renders.</p></div></div>"
    )


def failures(results: Iterable[RunResult], problems: Sequence[str]) -> str:
    """Runs that came to nothing with their reasons, and files that could not be read."""
    failed = [result for result in results if result.status == "failed"]
    if not failed and not problems:
        return ""
    rows = "".join(
        f"<tr><th scope=row>{escaped(r.spec.label)}</th><td>{escaped(r.spec.scene_name)}, {escaped(r.spec.protocol)}, "
        f"{escaped(r.spec.preset)} {escaped(r.spec.backbone)}, seed {r.spec.seed}</td><td>{escaped(r.reason)}</td></tr>"
        for r in failed
    )
    table = (
        '<div class="scroll" tabindex="0" role="region" aria-label="Failed runs"><table class="plain"><thead><tr>'
        "<th scope=col>composition</th><th scope=col>run</th><th scope=col>reason</th></tr></thead>"
        f"<tbody>{rows}</tbody></table></div>"
    )
    notes = "".join(f'<p class="note">{escaped(problem)}</p>' for problem in problems)
    return "<h2>What failed</h2>" + (table if failed else "") + notes


def provenance(study: Study, results: Sequence[RunResult]) -> str:
    """Protocols with their views, conventions of the metrics, versions and machines."""
    done = [result for result in results if result.status == "done" and result.metrics is not None]
    entries: list[tuple[str, str]] = []
    for protocol in dict.fromkeys(spec.protocol for spec in study.runs):
        entries.append((f"protocol {protocol}", _protocol(protocol, done)))
    conventions: dict[str, str] = {}
    for result in done:
        conventions.update((result.metrics or {}).get("conventions", {}))
    entries += sorted(conventions.items())
    for keys, title in ((_VERSIONS, "versions"), (_MACHINE, "machine")):
        found = dict.fromkeys(_versions(result, keys, with_name=title == "machine") for result in done)
        entries += [
            (title if len(found) == 1 else f"{title} {n}", text) for n, text in enumerate(found, 1) if text
        ]
    total = sum(result.seconds for result in done)
    entries.append(("runs", f"{len(done)} finished, {duration(total)} in all"))
    body = "".join(f"<dt>{escaped(name)}</dt><dd>{escaped(text)}</dd>" for name, text in entries)
    return f"<h2>Where the figures come from</h2><dl>{body}</dl>"


def _protocol(name: str, done: Sequence[RunResult]) -> str:
    own = [result.metrics or {} for result in done if result.spec.protocol == name]
    parts = []
    try:
        parts.append(f"background {get_protocol(name).background}")
    except InputError:
        parts.append("not known here")
    trained = dict.fromkeys(tuple(metrics.get("train_views", ())) for metrics in own)
    if len(trained) == 1:
        views = next(iter(trained))
        shown = " ".join(views[:12]) + (" ..." if len(views) > 12 else "")
        parts.append(f"trained on {len(views)} views: {shown}")
    tested = sorted({int(metrics["test_views"]) for metrics in own if "test_views" in metrics})
    if tested:
        parts.append(f"scored on {' or '.join(map(str, tested))} test views of each scene")
    return "; ".join(parts)


def _versions(result: RunResult, keys: Sequence[str], *, with_name: bool) -> str:
    versions = (result.metrics or {}).get("versions", {})
    parts = [f"{key} {versions[key]}" for key in keys if key in versions]
    return ", ".join([result.machine] * (with_name and bool(result.machine)) + parts)
