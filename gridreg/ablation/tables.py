"""Tables of a study as Markdown and as LaTeX, and figures as text.

Nothing is set in bold: the best figure of a column is often the luckiest. What differs from the baseline by more than
noise is told by a sign beside the difference, and the rest is said to be within noise.
"""

from __future__ import annotations

from collections.abc import Sequence

from gridreg.ablation.comparison import Row, Section
from gridreg.ablation.statistics import Estimate
from gridreg.ablation.templates import render
from gridreg.training.progress import clock_time

MINUS = "\N{MINUS SIGN}"

SIGNS = {
    "higher": "▲",
    "lower": "▼",
    "higher, uncorrected": "△",
    "lower, uncorrected": "▽",
    "within noise": "≈",
    "one pair": "·",
}
"""Mark of each outcome; hollow where the correction for the number of rows leaves nothing of it."""

LEGEND = (
    "± and [ ]: 95 % interval (Student's t) over scenes and seeds. Δ: mean difference to the baseline of the same "
    "scene, views, seed, preset and backbone. ▲ ▼: the interval leaves 0 out; △ ▽: it does, but not after Holm's "
    "correction for the number of rows; ≈: within noise; ·: one pair, no interval. α: uses the alpha masks of the "
    "training views."
)

_COLUMNS = ("composition", "PSNR (dB)", "Δ PSNR (dB)", "SSIM (Gaussian)", "training", "runs", "notes")
_SHOWN = ("psnr", "ssim_gaussian", "ssim_uniform")


def signed(value: float, digits: int = 2) -> str:
    """A difference with its sign; what rounds to 0 has none.

    >>> signed(0.416), signed(-0.0049), signed(-1)
    ('+0.42', '0.00', '−1.00')
    """
    text = f"{value:+.{digits}f}"
    return text[1:] if float(text) == 0 else text.replace("-", MINUS)


def mean_text(value: Estimate | None, digits: int = 2) -> str:
    """A mean with its interval, ``25.10 ± 0.42``; without one where there is a single run."""
    if value is None:
        return "–"
    spread = "" if value.half_width is None else f" ± {value.half_width:.{digits}f}"
    return f"{value.mean:.{digits}f}".replace("-", MINUS) + spread


def difference_text(row: Row) -> str:
    """A row's difference to the baseline with its interval and its sign."""
    if row.difference is None or row.difference.estimate is None:
        return "–"
    found = row.difference.estimate
    sign = SIGNS.get(row.outcome, "")
    if found.half_width is None:
        return f"{signed(found.mean)} {sign}"
    return f"{signed(found.mean)} [{signed(found.low)}, {signed(found.high)}] {sign}"


def duration(seconds: float) -> str:
    """Seconds for people.

    >>> duration(9.42), duration(75), duration(3725)
    ('9.4 s', '1:15 min', '1:02:05 h')
    """
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    return f"{clock_time(seconds)} {'h' if round(seconds) >= 3600 else 'min'}"


def notes_of(row: Row) -> list[str]:
    """Remarks that a reader needs to judge a row."""
    notes = [] if row.outcome in ("higher", "lower", "no result") else [row.outcome]
    if row.uses_alpha:
        notes.append("α")
    if row.failed:
        notes.append(f"{row.failed} failed")
    return notes


def further_metrics(section: Section) -> list[str]:
    """Names of metrics that have no column of their own, in a table that somebody else has made."""
    return list(dict.fromkeys(m for row in section.rows for m in row.metrics if m not in _SHOWN))


def columns_of(section: Section) -> tuple[str, ...]:
    """Heads of the columns of a section's table."""
    return (*_COLUMNS[:4], *further_metrics(section), *_COLUMNS[4:])


def markdown(title: str, sections: Sequence[Section]) -> str:
    """All tables of a study in Markdown (GitHub's tables), with a legend.

    Args:
        title: heading.
        sections: of `gridreg.ablation.comparison.compare`.
    """
    return render("tables.md", title=title, sections=sections, tables=_tables, legend=LEGEND)


def latex(title: str, sections: Sequence[Section]) -> str:
    """All tables of a study in LaTeX, which need the packages booktabs and amssymb; arguments as of `markdown`."""
    return render("tables.tex", title=title, sections=sections, tables=_tables, legend=LEGEND)


def _tables(section: Section) -> list[tuple[tuple[str, ...], list[tuple[str, ...]]]]:
    """Head and body of the table of a section, and of the one by scene where there are several scenes."""
    found = [(columns_of(section), [_cells(row, further_metrics(section)) for row in section.rows])]
    if len(section.scenes) > 1:
        body = [(row.name, *(mean_text(row.scenes.get(s)) for s in section.scenes)) for row in section.rows]
        found.append((("PSNR (dB)", *section.scenes), body))
    return found


def _cells(row: Row, further: Sequence[str]) -> tuple[str, ...]:
    return (
        row.name,
        mean_text(row.metrics.get("psnr")),
        difference_text(row),
        mean_text(row.metrics.get("ssim_gaussian"), 3),
        *(mean_text(row.metrics.get(metric), 3) for metric in further),
        duration(row.seconds.mean) if row.seconds else "–",
        f"{row.done}" if row.done == row.expected else f"{row.done} of {row.expected}",
        ", ".join(notes_of(row)),
    )
