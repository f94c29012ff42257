"""HTML from templates, and names of the figures in tables.

Each room keeps its templates in a folder `templates/`; `mien/templates` has what all pages share.

A page is one file that can be sent around. It needs no network and no scripts, and works in light, in dark and on
paper. The templates escape every text. Python code prepares what they show.
"""

import re
from functools import cache
from importlib.resources import files

import jinja2
from markupsafe import Markup, escape

LIVING_PAGE = "me.html"
"""Name of the living avatar's page in a workspace."""
METRICS = ("psnr", "ssim", "l1", "perceptual")
"""Names of the figures of scored pictures."""
COLUMNS = (
    ("psnr", "PSNR, dB", 2, True), ("ssim", "SSIM", 3, True), ("l1", "L1", 4, False),
    ("perceptual", "ST-LPIPS", 3, False),
)  # fmt: skip
"""Metric, heading, number of digits, whether higher is better."""


def render(template: str, **content: object) -> Markup:
    """HTML from a template, which is named by its path in `mien`. Text in `content` is escaped, `Markup` is not."""
    return Markup(_templates().get_template(template).render(content))


def with_code(text: str) -> Markup:
    """The text as HTML, with text between backticks as code. Templates know it as the filter `with_code`."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


@cache
def _templates() -> jinja2.Environment:
    folder = files("mien")
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: folder.joinpath(name).read_text(encoding="utf-8")),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["with_code"] = with_code
    # The colours of `mien.media.pictures.heat_colors` from 0 to its limit, without OpenCV.
    environment.globals["heat_gradient"] = (
        "linear-gradient(90deg,rgb(0, 0, 4), rgb(66, 10, 104), rgb(147, 38, 103), rgb(221, 81, 58), rgb(252, 165, 10), "
        "rgb(252, 255, 164))"
    )
    return environment
