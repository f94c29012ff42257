"""Constants that decide quality: each says what it is, is used, and can be changed by `benchmarks/ablate.py`."""

import ast
import contextlib
import importlib.util
from collections.abc import Iterator
from dataclasses import asdict, fields
from pathlib import Path
from types import ModuleType

import pytest
import torch

import mien
from mien.avatar.bound_surface import SurfacePrior
from mien.avatar.constants import AVATAR
from mien.commands.help_text import field_docs
from mien.errors import UserError

_FILE = Path(__file__).parents[1] / "benchmarks" / "ablate.py"


@pytest.fixture(scope="module")
def ablate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ablate", _FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_change_holds_as_long_as_it_is_asked_for(ablate: ModuleType) -> None:
    prior, before = SurfacePrior(torch.ones(3)), ablate.run_name("one", ["--steps", "9"])
    with ablate.changed(ablate.change_of("avatar.fill_height_share=0.25")):
        assert prior.fill_height.tolist() == [0.25] * 3
        assert ablate.run_name("one", ["--steps", "9"]) != before
    assert AVATAR.fill_height_share == 0.9
    with contextlib.suppress(UserError), ablate.changed(ablate.change_of("avatar.fill_height_share=0.25")):
        raise UserError("stop")
    assert AVATAR.fill_height_share == 0.9
    assert ablate.run_name("one", ["--steps", "9"]) == before != ablate.run_name("one", ["--steps", "8"])


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("whole_head.hair_frames=12", 12),
        ("avatar.calm_share=1", 1.0),
        ("whole_head.moving_near=(0.1, 0.2)", (0.1, 0.2)),
    ],
)
def test_changes_have_the_type_of_the_constant(ablate: ModuleType, text: str, value: object) -> None:
    assert ablate.change_of(text)[2] == value
    assert type(ablate.change_of(text)[2]) is type(value)


@pytest.mark.parametrize(
    "text",
    ["whole_head.hair=1", "nowhere.hair_frames=1", "avatar", "whole_head.hair_frames=1.5", "avatar.calm_share=few",
     "whole_head.moving_near=(0.1,)", "whole_head.hair_frames=True"],
)  # fmt: skip
def test_wrong_changes_are_refused(ablate: ModuleType, text: str) -> None:
    with pytest.raises(UserError, match=r"no such constant|give a value like"):
        ablate.change_of(text)


def test_the_table_has_differences_and_means(ablate: ModuleType) -> None:
    rows = [
        ablate.Figures(change, capture, psnr, psnr - 5, 60)
        for capture, shift in (("a", 0.0), ("b", 2.0))
        for change, psnr in (("unchanged", 30 + shift), ("x.y=1", 30.5 + shift / 2))
    ]
    assert ablate.table(rows).splitlines()[2:] == [
        "| unchanged | a | 30.00 | 25.00 | 60 |",
        "| x.y=1 | a | 30.50 (+0.50) | 25.50 (+0.50) | 60 |",
        "| unchanged | b | 32.00 | 27.00 | 60 |",
        "| x.y=1 | b | 31.50 (-0.50) | 26.50 (-0.50) | 60 |",
        "| unchanged | mean | 31.00 | 26.00 | 60 |",
        "| x.y=1 | mean | 31.00 (+0.00) | 26.00 (+0.00) | 60 |",
    ]
    assert len(ablate.table(rows[:2]).splitlines()) == 4


def _uses(tree: ast.AST, running: bool = False) -> Iterator[tuple[str, str, bool]]:
    """Every NAME.attribute of a module: both names, and whether it runs in a function, so after the import."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            yield node.value.id, node.attr, running
        if isinstance(node, ast.FunctionDef | ast.Lambda):
            yield from _uses(node.args, running)
            body: list[ast.stmt] = node.body if isinstance(node.body, list) else [ast.Expr(node.body)]
            yield from _uses(ast.Module(body, []), running=True)
        else:
            yield from _uses(node, running)


def test_every_constant_says_what_it_is_and_is_read_when_it_is_needed(ablate: ModuleType) -> None:
    root = Path(mien.__file__).parent
    used = {use for path in root.rglob("*.py") for use in _uses(ast.parse(path.read_text()))}
    for room, constants in ablate.rooms().items():
        path = next(p for p in root.rglob("constants.py") if p.parent.name == room)
        name = next(ast.unparse(n.targets[0]) for n in ast.parse(path.read_text()).body if isinstance(n, ast.Assign))
        docs, aliases = field_docs(type(constants)), {name, "known"}
        assert set(docs) == {each.name for each in fields(constants)}
        for field in asdict(constants):
            times = {running for instance, attribute, running in used if attribute == field and instance in aliases}
            assert times == {True}, f"{room}.{field} is never read, or read while modules are imported"
