"""The parts of the report's web page in HTML, which needs no other file: images stand in it as data."""

import base64
import html
import re
from collections.abc import Sequence

from matplotlib.figure import Figure

from cassie_mjx import cli
from cassie_mjx.reporting import plots
from cassie_mjx.reporting.results import Result
from cassie_mjx.reporting.tables import Table

_GENERATOR = '<meta name="generator" content="cassie-mjx report">'
REPORT = cli.marked("a report of ours", _GENERATOR.encode())
"""Pages that `document` has made."""

CSS = """
body { font: 1rem/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; margin: 0 auto; padding: 1rem;
       max-width: 66rem; }
h1 { line-height: 1.2; } h2 { margin-top: 2.5rem; border-top: 1px solid #ccc; padding-top: 1rem; }
code { font: 0.9em ui-monospace, monospace; } p code, li code { overflow-wrap: anywhere; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: 0.9rem; }
th, td { text-align: left; padding: 0.3rem 0.6rem; border-bottom: 1px solid #ddd; vertical-align: top; }
td { font-variant-numeric: tabular-nums; min-width: 4rem; }
tr > :first-child { position: sticky; left: 0; background: #fff; min-width: 8rem; font-weight: 600; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); gap: 1.5rem; }
figure { margin: 0; } figure img { width: 100%; max-width: 32rem; }
figcaption, .small, details { font-size: 0.85rem; color: #444; } .missing { color: #8a4b00; }
"""


def document(title: str, introduction: str, sections: Sequence[str]) -> str:
    """The whole page."""
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    head += _GENERATOR
    head += f"<title>{html.escape(title)}</title><style>{CSS}</style>"
    body = "\n".join([f"<h1>{html.escape(title)}</h1><p>{html.escape(introduction)}</p>", *sections])
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>{body}</body></html>\n'


def section(title: str, text: str, body: str, sources: Sequence[Result], command: str = "") -> str:
    """A part of the page; without any result file it says which command makes one."""
    if not sources:
        body += f'<p class="missing">Not measured yet. {inline(f"`{command}` measures it.") if command else ""}</p>'
    return f"<section><h2>{html.escape(title)}</h2><p>{html.escape(text)}</p>{body}{small_print(sources)}</section>"


def small_print(sources: Sequence[Result]) -> str:
    """Where the figures come from: file, command, hardware, date, commit, seed."""
    lines = []
    for result in sources:
        p = result.provenance
        seed = p.get("seed", result.seed)
        where = f"{p['hardware']}, {p['date']}, commit {p['commit']}" + ("" if seed in ("", None) else f", seed {seed}")
        line = f"`{result.name}`: `{p['command']}`; {where}"
        lines.append(f"<li>{inline(line)}</li>")
    return f"<details><summary>Sources</summary><ul>{''.join(lines)}</ul></details>" if lines else ""


def table(content: Table) -> str:
    """A table and its notes in HTML."""
    head = "".join(f"<th>{inline(cell)}</th>" for cell in content.header)
    rows = ["".join(f"<td>{inline(cell)}</td>" for cell in (*row[:-1], f"`{row[-1]}`")) for row in content.rows]
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    notes = "".join(f'<p class="small">{inline(note)}</p>' for note in content.notes)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>{notes}'


def drawn(shown: Sequence[tuple[Figure, str]]) -> str:
    """Figures with their captions, side by side where there is room; each image stands in the page itself."""
    items = []
    for figure, caption in shown:
        data = base64.b64encode(plots.svg(figure).encode()).decode()
        image = f'<img src="data:image/svg+xml;base64,{data}" alt="{html.escape(caption)}">'
        items.append(f"<figure>{image}<figcaption>{html.escape(caption)}</figcaption></figure>")
    return f'<div class="plots">{"".join(items)}</div>' if items else ""


def inline(text: str) -> str:
    """Text in HTML, with `code`."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))
