"""What every page has in common: it holds all it shows and may load nothing.

Its own policy (Content-Security-Policy) forbids every address and every script but the two
inside, which it knows by their hashes.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

import jinja2
from markupsafe import Markup

from samii_rig.errors import InputError
from samii_rig.record.export import replacing
from samii_rig.report.canvas import Figure, halved

_WORDS = {"good": "good", "found": "found", "note": "note", "warning": "look", "bad": "attention"}


@dataclass(frozen=True, slots=True)
class Plot:
    """One figure of the page and what is said above it.

    options : names of its sets, for a select; chosen : what they are. views : of each option
    there are so many sets, one after the other, for a second select. gain : its first panel is
    a gain, which may be shown in dB.
    """

    id: str
    title: str
    caption: str
    figure: Figure
    options: tuple[str, ...] = ()
    chosen: str = "Segment"
    views: tuple[str, ...] = ()
    gain: bool = False

    @property
    def json(self) -> Markup:
        """The figure as JSON that cannot end its script element."""
        text = json.dumps(halved(self.figure), separators=(",", ":"), allow_nan=False)
        return Markup(text.replace("<", "\\u003c"))


def page_text(template: str, plots: Iterable[Plot], **parts: object) -> str:
    """A page from `template` of the assets, with the style, scripts and data that it needs."""
    style, plotly = _asset("page.css"), _plotly()
    script = _asset("page.js") + _asset("video.js")
    return (
        _environment()
        .get_template(template)
        .render(
            policy=_policy(plotly, script),
            style=Markup(style),
            script=Markup(script),
            plotly=Markup(plotly),
            words=_WORDS,
            all_plots=list(plots),
            **parts,
        )
    )


def check_suffix(path: Path) -> None:
    """InputError unless `path` names a page."""
    if path.suffix.lower() != ".html":
        raise InputError("report", "suffix", path.suffix, ".html")


def put(path: Path, text: str) -> Path:
    """Write a page; nothing half-written is left. InputError where that is not possible."""
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def _policy(*scripts: str) -> str:
    """Content-Security-Policy: nothing from anywhere, and of scripts these alone.

    plotly sets styles on elements, so inline styles are allowed; blob and data images are its
    "save as PNG". A film that the reader opens from their own disk is a blob too.
    """
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'"
        for s in scripts
    )
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; "
        "img-src data: blob:; media-src blob:; form-action 'none'; base-uri 'none'"
    )


def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.FunctionLoader(_asset),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _asset(name: str) -> str:
    return (resources.files("samii_rig.report") / "assets" / name).read_text("utf-8")


@cache
def _plotly() -> str:
    """The part of plotly.js with lines, points and heat maps: a third of the whole. Its line ends
    are made the ones that a browser hashes."""
    return _asset("plotly-cartesian.min.js").replace("\r\n", "\n").replace("\r", "\n")
