"""Run the chosen parts of an analysis, and write analysis.json, a png for each chart and picture, and the page."""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mien
from mien import _native
from mien.disk.files import expect_whole, file_digest, read_json, write_json
from mien.disk.inside import check_tree, inside
from mien.disk.locks import hold
from mien.errors import UserError
from mien.lab.analysis.charts import write_chart
from mien.lab.analysis.context import Context, digest_of
from mien.lab.analysis.page import section_html, write_page
from mien.lab.analysis.result import PartResult, file_names
from mien.lab.analysis.spec import Analysis, AnalysisOptions, Part
from mien.machine.progress import say
from mien.media.picture_files import write_png
from mien.training.run import read_run_config, read_training_summary

FORMAT, VERSION = "mien.analysis", 1
PAGE, RECORD = "analysis.html", "analysis.json"
_REMEDY = "delete it and run the same `mien analyze` again"


def run_analysis(
    analysis: Analysis,
    parts: Sequence[Part],
    run_dir: Path,
    sequence_dirs: Sequence[Path],
    folder: Path,
    options: AnalysisOptions,
) -> dict[str, Any]:
    """Run some parts of an analysis, and return the content of analysis.json.

    A part that was computed before, for the same avatar and options, is kept. Each part is written once it is done.

    Args:
        analysis: The analysis of the run's method.
        parts: The parts to run.
        run_dir: A finished run.
        sequence_dirs: The folders of the run's sequences, in its order.
        folder: The folder to write into.
        options: Steps and seconds.
    """
    options.check()
    check_method(analysis, run_dir)
    read_training_summary(run_dir)
    check_tree(run_dir)
    check_tree(folder)
    with hold(folder):
        folder.mkdir(parents=True, exist_ok=True)
        context = Context(run_dir, tuple(sequence_dirs), folder, options)
        avatar = file_digest(run_dir / "avatar" / "avatar.safetensors")
        content = {
            "run": run_dir.name,
            "method": analysis.method,
            "paper": analysis.paper,
            "avatar": avatar,
            "parts": _known(folder, analysis, avatar),
            "mien": mien.__version__,
            "command_line": sys.argv,
        }
        for part in parts:
            key = _key(part, avatar, options)
            if content["parts"].get(part.name, {}).get("key") == key:
                say(f"{part.name}: measured before")
            else:
                result = part.run(context)
                _write_files(folder, result)
                content["parts"][part.name] = {"key": key, **json.loads(json.dumps(result.content()))}
                write_json(folder / RECORD, FORMAT, VERSION, content)
            for finding in content["parts"][part.name]["findings"]:
                say(f"{part.name}: {finding}")
        write_json(folder / RECORD, FORMAT, VERSION, content)
        write_page(folder / PAGE, analysis, content)
    return content


def check_method(analysis: Analysis, run_dir: Path) -> None:
    """Check that a run is of the method of an analysis."""
    found = read_run_config(run_dir)["method"]["kind"]
    if found != analysis.method:
        raise UserError(
            f"{run_dir}: is a run of {found}, not of {analysis.method}; choose a run of {analysis.method} with "
            f"--run NAME, or train one with `mien train --method {analysis.method}`"
        )


def _key(part: Part, avatar: str, options: AnalysisOptions) -> str:
    """A hash of everything that the result of a part depends on."""
    chosen = {name: getattr(options, name) for name in part.options}
    return digest_of([part.name, avatar, chosen, _native.thread_count() if part.timed else None])


def _known(folder: Path, analysis: Analysis, avatar: str) -> dict[str, Any]:
    """The parts in an analysis.json of this avatar that are whole; none if there is no such file."""
    path = folder / RECORD
    if not path.is_file():
        return {}
    content = read_json(path, FORMAT, VERSION, remedy=_REMEDY)
    with expect_whole(path, _REMEDY):
        if (content["method"], content["avatar"]) != (analysis.method, avatar):
            return {}
        return {
            part.name: content["parts"][part.name]
            for part in analysis.parts
            if part.name in content["parts"] and _is_whole(folder, part, content["parts"][part.name])
        }


def _is_whole(folder: Path, part: Part, content: Mapping[str, Any]) -> bool:
    """Whether the files of a part are there. Its section is made once, so that damaged content is found here."""
    if not all(inside(folder, name).is_file() for name in file_names(content)):
        return False
    return bool(section_html(part.summary, content, folder))


def _write_files(folder: Path, result: PartResult) -> None:
    for chart in result.charts:
        write_chart(inside(folder, f"{chart.name}.png"), chart)
    for picture in result.pictures:
        write_png(inside(folder, f"{picture.name}.png"), picture.image)
