"""`mien batch --paper`: from a folder of people, in whichever layout, to the table of a paper beside its figures."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

import dataset_writers as writers
from dataset_cases import make_quick, tiny_scene
from dataset_scene import Scene, scene_of
from mien.batch import drive
from mien.batch.paper import read_paper
from mien.cli import main
from mien.commands import batch as batch_command
from mien.commands.batch_paper import with_runs
from mien.commands.batch_table import read_table
from mien.disk.files import write_arrays
from mien.disk.workspace import Workspace
from mien.evaluation import cross
from mien.face.loading import add_face_model
from mien.lab.analysis.headgas_ablations import ABLATIONS
from mien.media.video import write_video
from mien.pipeline import track
from mien.training.settings.splits import SEQUENCES
from refusals import complaint
from shared_things import rows_here, write_sequence
from toy_scene import toy_capture, toy_face_model, toy_tracking

pytestmark = [pytest.mark.unchecked, pytest.mark.usefixtures("short_films")]
PAPERS = Path(__file__).parent.parent / "examples" / "papers"

SMALL = """
title = "A table"
source = "A paper"
subjects = 2
options = { preset = "draft", "method.points" = 60 }
columns = { "PSNR" = "self_reenactment.psnr", "Hours" = "training_hours" }

[[rows]]
name = "Theirs"
paper = ["30.10", "9"]

[[rows]]
name = "The Method"
method = "headgas"
options = { "method.features" = 4 }
paper = ["31.70", ""]
"""


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    make_quick(monkeypatch)
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    scene = tiny_scene(tmp_path)
    add_face_model(scene.model, tmp_path / "tiny.npz", "0")
    return scene


def people(folder: Path, scene: Scene, write: Callable[[Path, Scene], object], *names: str) -> Path:
    """Write files of each name. A subject is the same in all of its sequences: SUBJECT/SEQUENCE."""
    subjects = [name.partition("/")[0] for name in names]
    for subject, name in zip(subjects, names, strict=True):
        write(folder / name, scene_of(scene.arrays, scene.model, 3 if "/" in name else 6, subjects.index(subject)))
    return folder


def batch(given: Path, paper: Path, out: Path, *options: str) -> int:
    return main(["batch", str(given), "--paper", str(paper), "--out", str(out), "--jobs", "1", *options])


def table(out: Path) -> dict[str, list[str]]:
    """Return the cells of table.md by the name of the row."""
    lines = [line for line in (out / "table.md").read_text().splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line[1:-1].split("|")] for line in lines]
    return {row[0]: row[1:] for row in cells}


def test_a_short_table_goes_on_where_it_stopped(tmp_path: Path, scene: Scene, monkeypatch, capsys) -> None:
    ran, out, paper = rows_here(monkeypatch), tmp_path / "out", tmp_path / "paper.toml"
    paper.write_text(SMALL)
    given = people(tmp_path / "people", scene, partial(writers.write_insta, held_out=2), "ann", "bob", "eve")
    short = ("--steps", "4", "--face-model", "tiny", "--subjects", "1")
    assert batch(given, paper, out, *short) == 0
    found, told = table(out), capsys.readouterr().err
    assert "0 rows: " not in told
    stages = ("(import)", "(train the-method-4)", "(evaluate the-method-4)")
    assert all(f"stage {number} of 3 {name}" in told for number, name in enumerate(stages, 1))
    assert "the-method-4: scores its held-out frames" in told
    assert found[""] == ["PSNR", "paper", "Hours", "paper", "state"]
    assert found["Theirs"] == ["-", "30.10", "-", "9", "the paper's figures alone"]
    psnr, *others, state = found["The Method"]
    metrics = json.loads((out / "rows/ann/runs/the-method-4/metrics.json").read_text())
    assert psnr == f"{metrics['protocols']['self_reenactment']['psnr']:.2f}"
    assert others == ["31.70", "0.00", ""]
    assert state == "run short: 4 of 4,000 steps, 1 of 3 subjects"
    folder = str(out / "rows/ann")
    assert [words[:3] for words in ran] == [
        ["import", str(given / "ann"), "--face-model"], ["train", folder, "--run"], ["evaluate", folder, "--run"],
    ]  # fmt: skip
    assert ran[2][-2:] == ["--protocol", "insta"]
    assert batch(given, paper, out, *short) == 0
    assert (len(ran), table(out)) == (3, found), "all is done"
    (out / "states/ann.json").unlink()  # as if it had been killed at its end
    kept = {path: path.stat().st_mtime_ns for path in (out / "rows/ann").rglob("*.*") if path.is_file()}
    assert batch(given, paper, out, *short) == 0
    assert {path: path.stat().st_mtime_ns for path in kept} == kept, "nothing is trained or scored again"
    ran.clear()
    assert batch(given, paper, out, *short[:-1], "2") == 0
    assert {Path(words[1]).name for words in ran} == {"bob"}
    assert " ± " in table(out)["The Method"][0]
    assert table(out)["The Method"][-1] == "run short: 4 of 4,000 steps, 2 of 3 subjects"
    tex = (out / "table.tex").read_text()
    assert "The Method & " in tex
    assert "# A table\n\nA paper." in (out / "table.md").read_text()
    page = (out / "index.html").read_text()
    assert "<h2>A table</h2>" in page
    assert all(f"<td>{cell}</td>" in page for cell in table(out)["The Method"][:-1] if cell)


def test_faces_are_fitted_where_the_paper_fits_them(tmp_path: Path, scene: Scene, monkeypatch) -> None:
    """Table 2 of MonoGaussianAvatar: drawings of fitted faces, eroded and dilated."""
    rows_here(monkeypatch)
    paper, out = tmp_path / "paper.toml", tmp_path / "out"
    paper.write_text((PAPERS / "mono_gaussian_avatar.toml").read_text().replace('method = "point_avatar"\n', ""))
    given = people(tmp_path / "people", scene, writers.write_imavatar, "subject1")
    small = ("--preset", "draft", "--method.pretraining", "0", "--method.points", "60", "--fit-steps", "2")
    assert batch(given, paper, out, "--steps", "2", "--face-model", "tiny", *small) == 0
    metrics = json.loads((out / "rows/subject1/runs/monogaussianavatar-2/metrics.json").read_text())["protocols"]
    entry, found = metrics["self_reenactment_sequence"], table(out)["MonoGaussianAvatar"]
    assert entry["fitted"]["fit"]["steps"] == 2
    assert found[::2] == [
        f"{entry['opened']['l1']:.4f}", "-", f"{entry['opened']['ssim']:.3f}", f"{entry['opened']['psnr']:.2f}",
        f"run short: 2 of 300,000 steps, 1 of 3 subjects; with {' '.join(small)}",
    ]  # fmt: skip
    assert found[-2] == "30.83, 27.47, 31.76"


@pytest.mark.slow
def test_subjects_drive_each_other_once_all_are_imported(tmp_path: Path, scene: Scene, monkeypatch, capsys) -> None:
    """GaussianAvatars' data: a subject is a folder of exports of VHAP. Only FREE drives others."""
    ran, given, out, paper = rows_here(monkeypatch), tmp_path / "people", tmp_path / "out", tmp_path / "paper.toml"
    monkeypatch.setattr(
        cross, "measure", lambda driven, name: dict.fromkeys(FIGURES, 0.25) | {"frames": 6, "driver": name}
    )
    batches, whole = [], drive.drive
    monkeypatch.setattr(
        batch_command,
        "drive",
        lambda batch, rows, *more: batches.append([row.name for row in rows]) or whole(batch, rows, *more),
    )
    paper.write_text((PAPERS / "gaussian_avatars.toml").read_text().replace('method = "point_avatar"\n', ""))
    names = [f"{subject}/{subject}_{name}" for subject in ("306", "074") for name in (*SEQUENCES, "FREE")]
    people(given, scene, writers.write_vhap, *names)
    short = ("--preset", "draft", "--steps", "2", "--face-model", "tiny")
    told = complaint(capsys, "batch", given, "--paper", paper, "--out", out, *short, "--shard", "1/2")
    assert "subjects drive each other; leave --shard and --store out" in told
    assert batch(given, paper, out, *short) == 0
    assert batches == [["074-made", "306-made"], ["074", "306"]], "imports end before other rows begin"
    before = ran[: [words[0] for words in ran].index("train")]
    assert {words[1] for words in before} == {str(given / name) for name in names}, (
        "all are imported before any training"
    )
    metrics = json.loads((out / "rows/306/runs/gaussianavatars-2/metrics.json").read_text())["protocols"]
    assert set(metrics) == {"novel_view", "self_reenactment_sequence", "cross_reenactment"}
    assert metrics["self_reenactment_sequence"]["sequences"] == ["306_EXP-2"]
    assert [one["driver"] for one in metrics["cross_reenactment"]["drivers"]] == ["074_074_FREE"]
    found = table(out)["GaussianAvatars"]
    assert found[1:12:2] == ["31.6", "0.938", "0.065", "26.0", "0.910", "0.076"]
    assert found[12:] == [
        "0.250 ± 0.000",
        "0.250 ± 0.000",
        "run short: 2 of 600,000 steps, 2 of 9 subjects; with --preset draft",
    ]


FIGURES = (
    "expression_error", "expression_error_still", "head_rotation_error_degrees", "head_rotation_error_still_degrees",
    "mouth_correlation", "eyes_correlation", "faces_found",
)  # fmt: skip


def test_own_footage_is_captured_and_tracked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The toy head has no face that a detector finds: mattes and landmarks are given, and its tracking is known."""
    ran, paper, model = rows_here(monkeypatch), tmp_path / "paper.toml", toy_face_model()
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    add_face_model(model, tmp_path / "toy.npz", "none")
    film, alpha = toy_capture(model, 5, 48)
    write_video(tmp_path / "people/anna.mp4", iter(film.images[:, 0]), 25.0)
    for timestep, matte in enumerate(alpha[:, 0]):
        (tmp_path / "mattes").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / f"mattes/{timestep}.png"), matte)
    marks = np.random.default_rng(0).uniform(8, 40, (5, 478, 2)).astype(np.float32)
    write_arrays(tmp_path / "landmarks.safetensors", {"landmarks": marks})

    def tracked(workspace: Workspace, face_model: str, *_: object) -> None:
        assert (workspace.sequence_names(), face_model) == (["anna"], "toy")
        write_sequence(workspace.sequence_dir("anna"), film, toy_tracking(model, 5, 48), alpha)

    monkeypatch.setattr(track, "run_tracking_stage", tracked)
    paper.write_text(SMALL)
    options = ("--steps", "2", "--face-model", "toy", "--capture.crop", "none")
    files = (
        "--capture.mattes",
        str(tmp_path / "mattes"),
        "--capture.landmarks",
        str(tmp_path / "landmarks.safetensors"),
    )
    assert batch(tmp_path / "people", paper, tmp_path / "out", *options, *files) == 0
    assert [words[0] for words in ran] == ["capture", "track", "train", "evaluate"]
    psnr, *_, state = table(tmp_path / "out")["The Method"]
    assert float(psnr) > 5
    assert state.startswith("run short: 2 of 4,000 steps, 1 of 2 subjects; with --capture.crop none")


def test_each_layout_has_its_own_split_protocol_and_tracking(tmp_path: Path, scene: Scene, monkeypatch) -> None:
    ran, scored, first = rows_here(monkeypatch, lambda words: 0), {}, []
    for layout, write, paper in (
        ("nersemble", lambda folder, _: writers.write_nersemble(folder), "gaussian_avatars.toml"),
        ("nerface", writers.write_nerface, "headgas.toml"),
        ("nerface", writers.write_nerface, "mono_gaussian_avatar.toml"),
        ("nerf-blendshape", writers.write_nerf_blendshape, "headgas_ablations.toml"),
    ):  # fmt: skip
        given = people(tmp_path / f"{layout}-{paper}", scene, write, "306")
        ran.clear()
        assert batch(given, PAPERS / paper, tmp_path / f"out-{layout}-{paper}") == 0
        words = [[word for word in step if "306" not in word] for step in ran]
        made = [step[1:] for step in words if step[0] in ("import", "track")]
        train, evaluate = words[-2:]
        first += next(step[step.index("--method") + 1 :][:1] for step in words if step[0] == "train")
        scored[layout, paper] = [made, train[train.index("--split") + 1], evaluate[evaluate.index("--protocol") + 1]]
    assert first == ["gaussian_avatars", "headgas", "mono_gaussian_avatar", "headgas"], "the paper's own method"
    plain = ["--out", "--resume"]
    assert scored == {
        ("nersemble", "gaussian_avatars.toml"): [
            [plain, ["--tracking.schedule", "paper"]], "gaussian-avatars", "nersemble"
        ],
        ("nerface", "headgas.toml"): [[["--face-model", "coefficients-76", *plain]], "dataset", "nerface"],
        ("nerface", "mono_gaussian_avatar.toml"): [[plain, []], "dataset", "nerface"],
        ("nerf-blendshape", "headgas_ablations.toml"): [
            [["--face-model", "coefficients-46", *plain]], "dataset", "nerf-blendshape"
        ],
    }  # fmt: skip


MISTAKES = {
    'method = "headgas"': ('method = "headgaz"', "row 'The Method': give one of"),
    "psnr": ("psnrr", "column 'PSNR' 'self_reenactment.psnrr': a result has no such setting"),
    "draft": ("best", "row 'The Method': invalid choice 'best' for argument '--preset'"),
    "method.points": ("method.dots", "row 'The Method': Unrecognized options: --method.dots"),
    "Theirs": ("the method", "two rows have the name 'the method'"),
    '"30.10", "9"': ('"30.10"', "row 'Theirs' has 1 figure of the paper for 2 columns; give one for each"),
    "subjects = 2": ('subjects = "two"', "subjects 'two': give a whole number"),
    'name = "Theirs"': ('steps = 3\nname = "Theirs"', "row 1: steps: there is no such setting"),
    "source": ("sauce", "sauce: a table has no such setting; did you mean source?"),
    "[[rows]]": ("[[lines]]", "has no rows"),
    'title = "A table"': ("layouts = { insts = {} }", "layouts.insts: give one of"),
    "title = ": ("title ", "cannot be read as TOML"),
}


def test_files_that_a_table_needs_are_looked_at_before_any_work(tmp_path: Path, monkeypatch, capsys) -> None:
    """A subject's name is that of a link, not of what it leads to."""
    ran, people = rows_here(monkeypatch), tmp_path / "people"
    people.mkdir()
    (tmp_path / "clip.mp4").touch()
    for name in ("ann", "ben"):
        (people / f"{name}.mp4").symlink_to(tmp_path / "clip.mp4")
    (tmp_path / "paper.toml").write_text(SMALL)
    (tmp_path / "vgg.pth").write_bytes(b"not weights")
    given = ("batch", people, "--out", tmp_path / "out", "--paper")
    assert "nothere.toml: no such file; give a table" in complaint(capsys, *given, tmp_path / "nothere.toml")
    weights = (tmp_path / "paper.toml", "--lpips-weights", tmp_path / "vgg.pth")
    told = f"mien: --lpips-weights {tmp_path / 'vgg.pth'}: is not the file that torchvision published"
    assert complaint(capsys, *given, *weights).startswith(told)
    missing = complaint(capsys, *given, weights[0], "--capture.mattes", "nowhere")
    assert missing.startswith("mien: --capture.mattes nowhere: no such file")
    assert not ran
    assert [row.name for row in read_table(people, [])] == ["ann", "ben"]


@pytest.mark.parametrize("right", MISTAKES)
def test_mistakes_in_a_table_are_told_before_any_work(right: str, tmp_path: Path, monkeypatch, capsys) -> None:
    ran, (wrong, words) = rows_here(monkeypatch), MISTAKES[right]
    (tmp_path / "people").mkdir()
    (tmp_path / "people/ann.mp4").touch()
    (tmp_path / "paper.toml").write_text(SMALL.replace(right, wrong))
    line = ("batch", tmp_path / "people", "--paper", tmp_path / "paper.toml", "--out", tmp_path / "out")
    assert words in complaint(capsys, *line)
    assert not ran
    assert not (tmp_path / "out").exists()


def test_the_tables_of_the_papers_are_whole() -> None:
    found = {path.stem: with_runs(read_paper(path), path, {}) for path in PAPERS.glob("*.toml")}
    assert len(found) == 5
    steps = {line.method: line.steps for paper in found.values() for line in paper.rows if line.method}
    assert steps == {
        "point_avatar": 150_000,
        "gaussian_avatars": 600_000,
        "headgas": 50_000,
        "mono_gaussian_avatar": 300_000,
    }
    rows = [line.paper[:3] for line in found["headgas_ablations"].rows]
    known = [(count, ms, psnr) for _, count, ms, psnr in ABLATIONS.values()]
    assert rows == [
        ("" if count is None else f"{count // 1000}k", "" if ms is None else f"{ms / 1000:.3f}", f"{psnr:.2f}")
        for count, ms, psnr in known
    ]
