"""Tables of a study as Markdown, as LaTeX, and as rows for a CSV file.

Nothing is set in bold: the best figure of a column is often the luckiest. What differs from the baseline by more than
noise is told by a sign beside the difference, and the rest is said to be within noise.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from gridreg.ablation.comparison import Row, Section
from gridreg.ablation.statistics import Estimate

__all__ = [
    "MINUS",
    "SIGNS",
    "csv_rows",
    "difference_text",
    "duration",
    "latex",
    "markdown",
    "mean_text",
    "notes_of",
    "signed",
]

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
_LATEX_SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "%": r"\%", "_": r"\_",
    "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "<": r"\textless{}", ">": r"\textgreater{}",
    '"': r"\textquotedbl{}", "|": r"\textbar{}",
    MINUS: "$-$", "–": "--", "±": r"$\pm$", "Δ": r"$\Delta$", "α": r"$\alpha$", "≈": r"$\approx$", "·": r"$\cdot$",
    "▲": r"$\blacktriangle$", "▼": r"$\blacktriangledown$", "△": r"$\vartriangle$", "▽": r"$\triangledown$",
}  # fmt: skip


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
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02} h" if hours else f"{minutes}:{rest:02} min"


def notes_of(row: Row) -> list[str]:
    """What a reader must know to judge a row."""
    notes = [] if row.outcome in ("higher", "lower", "no result") else [row.outcome]
    if row.uses_alpha:
        notes.append("α")
    if row.failed:
        notes.append(f"{row.failed} failed")
    return notes


def _cells(row: Row) -> list[str]:
    return [
        row.name,
        mean_text(row.metrics.get("psnr")),
        difference_text(row),
        mean_text(row.metrics.get("ssim_gaussian"), 3),
        duration(row.seconds.mean) if row.seconds else "–",
        f"{row.done}" if row.done == row.expected else f"{row.done} of {row.expected}",
        ", ".join(notes_of(row)),
    ]


def _scene_cells(row: Row, scenes: Sequence[str]) -> list[str]:
    return [row.name, *(mean_text(row.scenes.get(scene)) for scene in scenes)]


def markdown(title: str, sections: Sequence[Section]) -> str:
    """All tables of a study in Markdown (GitHub's tables), with a legend.

    Args:
        title: heading.
        sections: of `gridreg.ablation.comparison.compare`.
    """
    parts = [f"# {_markdown(title)}"]
    for section in sections:
        parts += [f"## {_markdown(section.setting.title)}", f"Scenes: {_markdown(section.extent)}"]
        parts.append(_markdown_table(_COLUMNS, [_cells(row) for row in section.rows]))
        if len(section.scenes) > 1:
            head = ("PSNR (dB)", *section.scenes)
            parts.append(_markdown_table(head, [_scene_cells(row, section.scenes) for row in section.rows]))
    parts.append(LEGEND)
    return "\n\n".join(parts) + "\n"


def latex(title: str, sections: Sequence[Section]) -> str:
    """All tables of a study in LaTeX; they need the packages booktabs and amssymb.

    Args:
        title: goes into the captions.
        sections: of `gridreg.ablation.comparison.compare`.
    """
    parts = [r"% \usepackage{booktabs,amssymb}"]
    for section in sections:
        caption = f"{title}: {section.setting.title}. Scenes: {section.extent}. {LEGEND}"
        parts.append(_latex_table(_COLUMNS, [_cells(row) for row in section.rows], caption))
        if len(section.scenes) > 1:
            head = ("PSNR (dB)", *section.scenes)
            body = [_scene_cells(row, section.scenes) for row in section.rows]
            parts.append(_latex_table(head, body, f"{title}: {section.setting.title}, by scene."))
    return "\n\n".join(parts) + "\n"


def csv_rows(sections: Sequence[Section]) -> list[dict[str, str | int | float | bool | None]]:
    """One flat row for each table row and scene, and one with ``scene`` empty for all scenes together.

    Every row has the same keys. Figures are numbers in full precision, None where there is none.
    """
    rows: list[dict[str, str | int | float | bool | None]] = []
    metrics = dict.fromkeys(m for section in sections for row in section.rows for m in row.metrics)
    for section in sections:
        for row in section.rows:
            for scene in ("", *section.scenes):
                difference = row.scene_differences.get(scene) if scene else row.difference
                found = difference.estimate if difference else None
                known = {"psnr": row.scenes.get(scene)} if scene else row.metrics
                figures = {name: known.get(name) for name in metrics}
                seconds = row.seconds.mean if row.seconds and not scene else None
                rows.append(
                    {
                        "builtin": section.setting.builtin,
                        "protocol": section.setting.protocol,
                        "views": section.setting.views,
                        "composition": row.label,
                        "preset": row.preset,
                        "backbone": row.backbone,
                        "scene": scene,
                        "uses_alpha": row.uses_alpha,
                        **{name: value.mean if value else None for name, value in figures.items()},
                        **{f"{n}_half_width": v.half_width if v else None for n, v in figures.items()},
                        "psnr_difference": found.mean if found else None,
                        "psnr_difference_half_width": found.half_width if found else None,
                        "pairs": found.count if found else 0,
                        "outcome": row.outcome if not scene else (difference.verdict if difference else ""),
                        "train_seconds": seconds,
                    }
                )
    return rows


def _markdown(text: str) -> str:
    safe = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    # A backslash before punctuation makes it text, in tables too.
    return re.sub(r"([\\`*_\[\]#|~$!])", r"\\\1", " ".join(safe.split()))


def _latex(text: str) -> str:
    return "".join(_LATEX_SPECIAL.get(character, character) for character in " ".join(text.split()))


def _markdown_table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    def line(cells: Sequence[str], escape: Callable[[str], str] = _markdown) -> str:
        return "| " + " | ".join(escape(cell) for cell in cells) + " |"

    rule = ["---"] + ["---:"] * (len(head) - 1)
    return "\n".join([line(head), line(rule, str), *(line(cells) for cells in body)])


def _latex_table(head: Sequence[str], body: Sequence[Sequence[str]], caption: str) -> str:
    def line(cells: Sequence[str]) -> str:
        # After a row's end, LaTeX takes an opening bracket for an option.
        return (
            "  "
            + " & ".join(f"{{{text}}}" if (text := _latex(c))[:1] == "[" else text for c in cells)
            + r" \\"
        )

    return "\n".join(
        [
            r"\begin{table}",
            rf"  \caption{{{_latex(caption)}}}",
            rf"  \begin{{tabular}}{{l{'r' * (len(head) - 1)}}}",
            r"  \toprule",
            line(head),
            r"  \midrule",
            *(line(cells) for cells in body),
            r"  \bottomrule",
            r"  \end{tabular}",
            r"\end{table}",
        ]
    )
