"""Run the chosen parts of an analysis, and write analysis.json, a file for each chart and picture, and the page."""

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mien
from mien import _native
from mien.disk.files import expect_whole, file_digest, read_json, write_atomically, write_json
from mien.disk.inside import check_tree, inside
from mien.disk.locks import hold
from mien.errors import UserError
from mien.lab.analysis.context import Context, digest_of
from mien.lab.analysis.registry import Analysis, AnalysisOptions, Part
from mien.lab.analysis.result import file_names, section_html
from mien.machine.progress import say
from mien.pages.pages import render
from mien.plugins import named
from mien.training.run import read_run_config, read_training_summary

_FORMAT, _VERSION = "mien.analysis", 1
_REMEDY = "delete it and run the same `mien analyze` again"


def run_analysis(
    analysis: Analysis,
    parts: Sequence[Part],
    run_dir: Path,
    sequence_dirs: Sequence[Path],
    folder: Path,
    options: AnalysisOptions,
) -> dict[str, Any]:
    """Run some parts of an analysis on a finished run, and return the content of analysis.json.

    A part that was computed before, for the same avatar and options, is kept. Each part is written once it is done.
    """
    options.check()
    check_method(analysis, run_dir)
    read_training_summary(run_dir)
    check_tree(run_dir)
    check_tree(folder)
    record = folder / "analysis.json"
    with hold(folder):
        folder.mkdir(parents=True, exist_ok=True)
        avatar = file_digest(run_dir / "avatar" / "avatar.safetensors")
        content = {
            "run": run_dir.name,
            "method": analysis.method,
            "paper": analysis.paper,
            "avatar": avatar,
            "parts": _known(record, analysis, avatar),
            "mien": mien.__version__,
            "command_line": sys.argv,
        }
        context = Context(run_dir, tuple(sequence_dirs), folder, options)
        for part in parts:
            key = _key(part, avatar, options)
            if content["parts"].get(part.name, {}).get("key") == key:
                say(f"{part.name}: measured before")
            else:
                run = named(f"mien.lab.analysis.{analysis.method}:{part.name.replace('-', '_')}")
                result = json.loads(json.dumps(run(context).write(folder)))
                content["parts"][part.name] = {"key": key, **result}
                write_json(record, _FORMAT, _VERSION, content)
            for finding in content["parts"][part.name]["findings"]:
                say(f"{part.name}: {finding}")
        with expect_whole(record, _REMEDY):
            page = _page(analysis, content, folder)
        write_json(record, _FORMAT, _VERSION, content)
        write_atomically(folder / "analysis.html", lambda aside: aside.write_text(page, encoding="utf-8"))
    return content


def check_method(analysis: Analysis, run_dir: Path) -> None:
    """Check that a run is of the method of an analysis."""
    method = read_run_config(run_dir)["method"]["kind"]
    if method != analysis.method:
        raise UserError(
            f"{run_dir}: is a run of {method}, not of {analysis.method}; choose a run of {analysis.method} with "
            f"--run NAME, or train one with `mien train --method {analysis.method}`"
        )


def _key(part: Part, avatar: str, options: AnalysisOptions) -> str:
    """A hash of everything that the result of a part depends on."""
    steps = options.steps if part.trainings else None
    timed = [options.seconds, _native.thread_count()] if part.timed else None
    return digest_of([part.name, avatar, steps, timed])


def _known(record: Path, analysis: Analysis, avatar: str) -> dict[str, Any]:
    """The parts of this avatar that were computed before, and whose files are all there."""
    if not record.is_file():
        return {}
    content = read_json(record, _FORMAT, _VERSION, remedy=_REMEDY)
    with expect_whole(record, _REMEDY):
        if (content["method"], content["avatar"]) != (analysis.method, avatar):
            return {}
        kept = {part.name: content["parts"][part.name] for part in analysis.parts if part.name in content["parts"]}
        folder = record.parent
        return {
            name: part
            for name, part in kept.items()
            if all(inside(folder, file).is_file() for file in file_names(part))
        }


def _page(analysis: Analysis, content: dict[str, Any], folder: Path) -> str:
    parts = content["parts"]
    return render(
        "lab/analysis/templates/analysis.html",
        title=f"{content['run']} · {analysis.method}",
        paper=content["paper"],
        version=content["mien"],
        command=shlex.join(["mien", *content["command_line"][1:]]),
        sections=[section_html(one.title, parts[one.name], folder) for one in analysis.parts if one.name in parts],
    )
