"""One HTML file that shows what a study found, with nothing beside it and nothing from a network."""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol

from gridreg.ablation.comparison import Section, compare
from gridreg.ablation.curves import curves, over_views
from gridreg.ablation.differences import forest_plot, heat_map
from gridreg.ablation.html_parts import escaped, failures, findings, provenance, sortable_table, wipe
from gridreg.ablation.mask_pictures import mask_schedules
from gridreg.ablation.records import RunResult, Study
from gridreg.ablation.tables import latex, markdown
from gridreg.ablation.wipes import wipe_data
from gridreg.errors import InputError
from gridreg.training.files import write_bytes

__all__ = ["PICTURE_BYTES", "HasResults", "write_report"]

PICTURE_BYTES = 6_000_000
"""Default bound on what pictures add to the page."""


class HasResults(Protocol):
    """What a report asks of a store."""

    def results(self, study: Study) -> list[RunResult]:
        """What is known of the runs of a study."""


class _Histories:
    """Reads each run's history once; one that cannot be read is empty, and said."""

    def __init__(self) -> None:
        self.problems: list[str] = []
        self._known: dict[Path, Sequence[Mapping[str, object]]] = {}

    def __call__(self, result: RunResult) -> Sequence[Mapping[str, object]]:
        if result.folder not in self._known:
            try:
                rows = result.history()
            except InputError as error:
                self.problems.append(str(error))
                rows = []
            self._known[result.folder] = [row for row in rows if isinstance(row, dict) and "step" in row]
        return self._known[result.folder]


def write_report(
    store: HasResults, study: Study, path: str | os.PathLike[str], *, picture_bytes: int = PICTURE_BYTES
) -> Path:
    """Write the report of a study, and its tables as Markdown and LaTeX beside it.

    The same results make the same bytes. A study that is not finished yet is reported as far as it is.

    Args:
        store: gives the results of the study.
        study: what was asked.
        path: of the HTML file; the tables have its name with the endings ``.md`` and ``.tex``.
        picture_bytes: bound on what the pictures of the slider add to the file.

    Returns:
        The path.

    Raises:
        InputError: the name does not end in ``.html``, or the place is not writable; what stood there stays.
    """
    place = Path(path)
    if place.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{place}: found the ending {place.suffix!r}, expected .html")
    results = store.results(study)
    sections = compare(study, results)
    page = _page(study, results, sections, picture_bytes)
    for ending, text in (
        (".md", markdown(study.title, sections)),
        (".tex", latex(study.title, sections)),
        (place.suffix, page),
    ):
        # Names of files that are not UTF-8 hold lone surrogates, which UTF-8 cannot write.
        write_bytes(place.with_suffix(ending), text.encode("utf-8", "backslashreplace"))
    return place


def _page(study: Study, results: Sequence[RunResult], sections: Sequence[Section], picture_bytes: int) -> str:
    histories = _Histories()
    pictures = wipe_data(sections, picture_bytes)
    parts = [
        _section(number, section, histories, pictures[number]) for number, section in enumerate(sections)
    ]
    views = over_views(sections)
    if views:
        parts.insert(0, f'<section id="views" class="curves"><h2>More views</h2>{views}</section>')
    masks = mask_schedules(results, histories)
    done = sum(result.status == "done" for result in results)
    lead = f"{done} of {len(study.runs)} runs are finished. Baseline: {study.baseline}."
    return _filled(
        _file("report.html"),
        {
            "title": escaped(study.title),
            "lead": escaped(lead),
            "contents": _contents(sections, bool(views), bool(masks)),
            "style": _file("report.css").strip(),
            "script": _file("report.js").strip(),
            "sections": "\n".join(parts),
            "masks": f"<h2>How the masks open</h2>{masks}" if masks else "",
            "failures": failures(results, histories.problems),
            "provenance": provenance(study, results),
            "file": escaped(f"{study.name}.yaml"),
            "download": _yaml_uri(study.source),
            "source": escaped(study.source),
            "pictures": _script_data(pictures),
        },
    )


def _section(
    number: int, section: Section, histories: _Histories, pictures: Sequence[Mapping[str, Any]]
) -> str:
    forest, heat, lines = forest_plot(section), heat_map(section), curves(section, histories)
    parts = [
        f'<section id="table{number}"><h2>{escaped(section.setting.title)}</h2>',
        f'<p class="lead">Scenes: {escaped(section.extent)}</p>',
        findings(section),
        sortable_table(section),
        f"<h3>Paired differences</h3>{forest}{_FOREST_NOTE}" if forest else "",
        f"<h3>By scene</h3>{heat}" if heat else "",
        f'<h3>Over time</h3><div class="curves">{lines}</div>' if lines else "",
        wipe(number, section, pictures),
        "</section>",
    ]
    return "\n".join(part for part in parts if part)


_FOREST_NOTE = (
    '<p class="note">Large dots are means, bars their 95 % intervals, small dots single pairs. Hollow: within noise, '
    "or not a finding any more among so many rows (Holm).</p>"
)


def _contents(sections: Sequence[Section], views: bool, masks: bool) -> str:
    links = [("views", "More views")] * views
    links += [(f"table{number}", section.setting.title) for number, section in enumerate(sections)]
    links += [("masks", "Masks")] * masks
    links += [("provenance", "Machine and versions"), ("study", "The study")]
    return " ".join(f'<a href="#{anchor}">{escaped(text)}</a>' for anchor, text in links)


def _filled(template: str, values: Mapping[str, str]) -> str:
    """The template with every ``{{name}}`` replaced; what is put in is not looked at again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], template)


def _file(name: str) -> str:
    return (files("gridreg.ablation") / "page" / name).read_text(encoding="utf-8")


def _yaml_uri(source: str) -> str:
    return "data:text/yaml;base64," + base64.b64encode(source.encode("utf-8", "backslashreplace")).decode()


def _script_data(value: Iterable[Any]) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
