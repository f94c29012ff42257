"""A webcam in the exported page: a drawn head drives it, calmly and from its neutral face; nothing leaves the page."""

import base64
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mien.driving.follower import OneEuro
from mien.face import FaceModel, FaceParams
from mien.formats.page import PageOptions, write_packed, write_page
from mien.formats.shared.webcam import VERSION
from mien.lab.synthetic import motion, scene
from mien.lab.synthetic.recipe import SyntheticRecipe
from mien.lab.synthetic.scene import SyntheticScene
from web_case import WEB, browse, drawn_head, expect_usable, run_node, script, served, tasks_vision

FAKE = "--use-fake-device-for-media-stream"
ALLOWED = "--use-fake-ui-for-media-stream"
WINDOW = (640, 320)
TRUE = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight")
FACES = np.array([[0, 0, 0], [0.6, 0, 0], [0, 1, 1], [0, 0, 0]])
"""Coefficients of the pictures: at rest, an open mouth, shut eyes, and a turned head."""
TURNS = np.array([0, 0, 0, 0.15])
"""Turns of the head to the person's left in the same pictures, in radians."""
CAMERA = """(() => {
  const picture = new OffscreenCanvas(360, 360), brush = picture.getContext("2d"), make = createImageBitmap;
  const { postMessage } = Worker.prototype;
  let see = () => {}, answered = () => {};
  HTMLVideoElement.prototype.requestVideoFrameCallback = (callback) => void (see = callback);
  window.createImageBitmap = () => make(picture);
  Worker.prototype.postMessage = function (message, moved) {
    if (message.picture) this.addEventListener("message", () => setTimeout(answered), { once: true });
    postMessage.call(this, message, moved);
  };
  let milliseconds = 0;
  window.film = async (address) => {
    const image = new Image(), done = new Promise((resolve) => (answered = resolve));
    image.src = address;
    await image.decode();
    brush.drawImage(image, 0, 0);
    see((milliseconds += 250));
    await done;
  };
})()"""
"""Lets `film` show the page a picture, 0.25 s after the last one, and wait until the detector has seen it."""


@pytest.fixture(scope="module")
def pictures() -> list[str]:
    count = len(FACES)
    recipe = SyntheticRecipe(
        width=360, height=360, fps=4.0, seconds=count / 4, glasses=False, supersample=1, texture_size=512
    )

    def posed(model: FaceModel, *given: Any) -> FaceParams:
        own, rest = motion.generate_motion(model, *given), model.neutral(count)
        expression, rotation = rest.expression.clone(), torch.zeros(count, 3)
        expression[:, [model.expression_names.index(name) for name in TRUE]] = torch.from_numpy(FACES).float()
        rotation[:, 1] = torch.from_numpy(TURNS).float()
        placed = replace(rest, identity=own.identity, head_translation=own.head_translation[:1].expand(count, -1))
        return replace(placed, expression=expression, head_rotation=rotation)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(scene, "generate_motion", posed)
        frames = list(SyntheticScene(recipe, 2).frames())
    packed = (cv2.imencode(".jpg", each.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1] for each in frames)
    return ["data:image/jpeg;base64," + base64.b64encode(each.tobytes()).decode() for each in packed]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tasks_vision()
    path = tmp_path_factory.mktemp("page") / "me.html"
    write_page(path, drawn_head(150), None, PageOptions(webcam=True))
    return path


RECORD = """(async () => {
  const viewer = await mien, camera = await webcam, { video, onState } = camera, [frames, names] = GIVEN;
  const log = { faces: [], states: [] }, button = document.getElementById("camera");
  const columns = names.map((name) => viewer.avatar.expression_names.indexOf(name));
  const begun = async () => {
    button.click();
    while (camera.state !== "calibrating") await new Promise((done) => setTimeout(done, 20));
  };
  const see = async (frame) => { for (let k = 0; k < 10; ++k) await film(frame); };
  camera.onState = (state, why) => (onState(state, why), log.states.push(state));
  document.getElementById("mirrored").click();
  await begun();
  await see(frames[1]);
  // The automatic neutral face may be any; the button takes that of a face at rest.
  document.getElementById("neutral").click();
  for (const frame of frames) {
    await see(frame);
    log.faces.push([viewer.face.head_rotation[1], ...columns.map((k) => viewer.face.expression[k])]);
  }
  const tracks = video.srcObject.getTracks(), ended = () => tracks.every((track) => track.readyState === "ended");
  log.ended = [ended()];
  Object.defineProperty(document, "hidden", { value: true, configurable: true });
  document.dispatchEvent(new Event("visibilitychange"));
  delete document.hidden;
  log.ended.push(ended());
  log.text = document.getElementById("camera-state").textContent;
  const rest = viewer.avatar.neutral.expression;
  log.rested = viewer.face.expression.every((value, k) => value === rest[k]);
  log.label = button.textContent;
  await begun();
  await see(frames[0]);
  camera.stop();
  return log;
})()"""


@pytest.mark.unchecked
def test_a_drawn_head_drives_jaw_and_blinks(page: Path, pictures: list[str]) -> None:
    """Coefficients of the avatar against the true ones of each picture. A hidden page stops, and starts again."""
    given = json.dumps([pictures, TRUE])
    told = browse(page, [RECORD.replace("GIVEN", given)], WINDOW, flags=[FAKE, ALLOWED], opening=CAMERA)
    (log,) = told["results"]
    assert told["messages"] == []
    # The worker's script and two scripts of MediaPipe, all from the page's own memory.
    assert {address.partition(":")[0] for address in told["requests"]} <= {"blob", "data"}
    again = ["opening", "calibrating", "running"]
    assert log["states"] == [*again, "calibrating", "running", "off", *again, "off"]
    hidden = "The camera is off, because the page was hidden."
    assert [log[name] for name in ("ended", "text", "rested", "label")] == [[False, True], hidden, True, "Be me"]
    turned, *driven = np.array(log["faces"]).T
    for truth, shown, name in zip(FACES.T, driven, TRUE, strict=True):
        assert (shown[truth == 0] < 0.1).all(), name
        assert (shown[truth > 0] > 0.7 * truth.max()).all(), name
    turned -= drawn_head(1).neutral.head_rotation[1]
    assert turned[3] - turned[0] == pytest.approx(TURNS[3], rel=0.3)


PRESS = """
  await webcam;
  const button = document.getElementById("camera"), told = document.getElementById("camera-state");
  navigator.mediaDevices.getUserMedia = async () => { throw new DOMException("", NAME); };
  if (!NAME) Object.defineProperty(navigator, "mediaDevices", { value: undefined });
  told.textContent = "";
  button.click();
  const said = () => /^(The camera|There|This|Browsers)/.test(told.textContent);
  while (!said()) await new Promise((done) => setTimeout(done, 20));
  return [told.textContent, button.textContent, told.getAttribute("role"), (await webcam).state];
"""
WRONG = {
    "NotAllowedError": "The camera is not allowed. Allow it for this page",
    "NotFoundError": "There is no camera. Connect one",
    "": "This browser gives no camera to a page from a file. Open the file with Chrome",
}
TRY_TO_SEND = """(async () => {
  const away = "https://example.com/", refused = new Set();
  document.addEventListener("securitypolicyviolation", (event) => refused.add(event.effectiveDirective));
  fetch(away).catch(() => {});
  try { new WebSocket("wss://example.com/"); } catch {}
  navigator.sendBeacon(away, "x");
  const [image, form, frame, script] = ["img", "form", "iframe", "script"].map((name) => document.createElement(name));
  image.src = frame.src = script.src = form.action = away;
  document.body.append(form, frame, script);
  form.submit();
  await new Promise((done) => setTimeout(done, 1000));
  return [...refused].sort();
})()"""


def test_what_is_wrong_is_said_and_nothing_could_be_sent(page: Path) -> None:
    presses = [script(PRESS.replace("NAME", json.dumps(name))) for name in WRONG]
    told = browse(page, [*presses, TRY_TO_SEND], (900, 900))
    *pressed, refused = told["results"]
    for (text, *state), message in zip(pressed, WRONG.values(), strict=True):
        assert text.startswith(message)
        assert state == ["Be me", "status", "off"]
    for part in ("MediaPipe Authors", f"vision {VERSION}", "TensorFlow", "OpenCV", "Apache License\n", "MIT License"):
        assert part in page.read_text()
    assert refused == ["connect-src", "form-action", "frame-src", "img-src", "script-src-elem"]
    assert set(told["requests"]) <= {"https://example.com/"}, "those that the last script tries, and the page refuses"
    expect_usable(page, 'await webcam; document.getElementById("more").click();')


CLASS = """
  const avatar = document.querySelector("mien-avatar"), told = document.querySelector("span"), [rest, open] = GIVEN;
  const until = async (ready) => { while (!ready()) await new Promise((done) => setTimeout(done, 20)); };
  await until(() => avatar.viewer);
  document.querySelector("button").click();
  await until(() => /fetched|second|calibrating/.test(told.textContent));
  if (told.textContent.includes("fetched")) return [told.textContent];
  const jaw = avatar.viewer.avatar.expression_names.indexOf("jawOpen"), { expression } = avatar.viewer.face;
  const jaws = [];
  const shut = () => expression[jaw] < 0.1, wide = () => expression[jaw] > 0.25;
  for (const [frame, arrived] of [[rest, shut], [open, wide], [rest, shut]]) {  // a busy machine drops frames
    for (let k = 0; k < 8 || (k < 400 && !arrived()); ++k) await film(frame);
    jaws.push(expression[jaw]);
  }
  return [told.textContent, jaws];
"""


@pytest.mark.unchecked
def test_the_class_drives_the_element(tmp_path: Path, built: Path, pictures: list[str], test_data: Path) -> None:
    """The example page, from a web server, with files of the package and the model beside it."""
    write_packed(tmp_path / "me.packed", drawn_head(150))
    for source, name in ((built, "element.js"), (built, "webcam.js"), (WEB / "examples", "webcam.html")):
        shutil.copy(source / name, tmp_path)
    (tmp_path / "tasks-vision").symlink_to(tasks_vision())
    steps, flags = [script(CLASS.replace("GIVEN", json.dumps(pictures[:2])))], [FAKE, ALLOWED]
    with served(tmp_path) as address:
        without = browse(f"{address}/webcam.html", steps, WINDOW, flags=flags, opening=CAMERA)
        (tmp_path / "face_landmarker.task").symlink_to(test_data / "mediapipe" / "face_landmarker.task")
        told = browse(f"{address}/webcam.html", steps, WINDOW, flags=flags, opening=CAMERA)
    assert without["results"] == [["face_landmarker.task cannot be fetched: the server answers 404."]]
    ((state, (rest, open_, again)),) = told["results"]
    assert state == "running"
    assert max(rest, again) < 0.1 < 0.25 < open_
    assert all(request.startswith((address, "blob:", "data:")) for request in told["requests"])


def found(seconds: float, scores: dict[str, float], rotvec: Any = (0, 0, 0), at: Any = (0, 0, 0)) -> dict[str, Any]:
    """Return what a detector says about a picture: a head in front of the camera, with place in metres."""
    matrix = np.eye(4)
    matrix[:3, :3] = 1.1 * Rotation.from_rotvec(rotvec).as_matrix()
    matrix[:3, 3] = 100 * np.asarray(at) + (0, 0, -40)
    where = {"matrix": matrix.T.reshape(-1).tolist(), "milliseconds": 1000 * seconds, "work": 1}
    return {"scores": list(scores.items()), **where}


def followed(built: Path, mirrored: bool, pictures: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    return run_node("webcam.mjs", built / "webcam.js", {"mirrored": mirrored, "found": pictures, **more})


AT_REST = {"jawOpen": 0.1, "eyeBlinkLeft": 0.2, "eyeBlinkRight": 0.15, "mouthSmileLeft": 0.3, "mouthSmileRight": 0.3}
REST_TURN = [0.1, 0.2, -0.05]


def second_at_rest() -> list[dict[str, Any]]:
    blink = AT_REST | {"eyeBlinkLeft": 0.7, "eyeBlinkRight": 0.7}
    return [found(i / 30, blink if i in (9, 10, 11) else AT_REST, REST_TURN, (0.02, 0, 0)) for i in range(31)]


@pytest.mark.parametrize("mirrored", [False, True])
def test_faces_are_relative_to_the_neutral_one(built: Path, mirrored: bool) -> None:
    """Held for two seconds, so that no smoothing is left."""
    held = {"jawOpen": 1.0, "eyeBlinkLeft": 0.75, "eyeBlinkRight": 0.15, "mouthSmileLeft": 0.1, "mouthSmileRight": 0.3}
    turn = (Rotation.from_rotvec(REST_TURN) * Rotation.from_rotvec([0.2, 0.3, 0.1])).as_rotvec()
    at = np.array([0.02, 0, 0]) + Rotation.from_rotvec(REST_TURN).as_matrix() @ [0.01, 0.02, -0.005]
    rest = second_at_rest()
    told = followed(built, mirrored, rest + [found(1.1 + i / 30, held, turn, at) for i in range(60)])["readings"]
    assert told[: len(rest) - 1] == [None] * (len(rest) - 1)
    first, last = told[len(rest) - 1], told[-1]
    assert first["scores"] == pytest.approx(dict.fromkeys(first["scores"], 0), abs=1e-6)
    np.testing.assert_allclose(first["turn"], np.eye(3).reshape(-1), atol=1e-6)
    closed, open_ = ("eyeblinkright", "eyeblinkleft") if mirrored else ("eyeblinkleft", "eyeblinkright")
    less, same = ("mouthsmileright", "mouthsmileleft") if mirrored else ("mouthsmileleft", "mouthsmileright")
    expected = {"jawopen": 1, closed: 1, open_: 0, less: -0.2, same: 0}
    assert last["scores"] == pytest.approx(expected, abs=1e-3)
    side = -1 if mirrored else 1
    expected_turn = Rotation.from_rotvec([0.2, side * 0.3, side * 0.1]).as_matrix()
    np.testing.assert_allclose(np.reshape(last["turn"], (3, 3)), expected_turn, atol=1e-2)
    np.testing.assert_allclose(last["shift"], [side * 0.01, 0.02, -0.005], atol=1e-3)


def test_a_mouth_that_is_open_at_first_is_not_neutral(built: Path) -> None:
    """An open mouth and a head far aside in the first second are motion; raised brows may be how one looks at rest."""
    turn = Rotation.from_rotvec([0, 0.9, 0])
    pictures = [found(i / 30, {"jawOpen": 0.7, "browInnerUp": 0.6}, turn.as_rotvec()) for i in range(90)]
    last = followed(built, False, pictures)["readings"][-1]
    assert last["scores"] == pytest.approx({"jawopen": 0.7, "browinnerup": 0}, abs=1e-3)
    np.testing.assert_allclose(last["turn"], turn.as_matrix().reshape(-1), atol=1e-2)
    # The button takes another neutral face.
    smile = AT_REST | {"mouthSmileLeft": 0.6, "mouthSmileRight": 0.6}
    pictures = second_at_rest() + [found(1.1 + i / 30, smile) for i in range(60)]
    readings = followed(built, False, pictures, recalibrate=40)["readings"]
    before, after = ((readings[at]["calibrating"], readings[at]["scores"]["mouthsmileleft"]) for at in (45, -1))
    assert (before[0], after[0]) == (True, False)
    assert before[1] > 0.2 > 1e-2 > abs(after[1])


def test_a_lost_face_says_nothing_and_smoothing_is_that_of_the_viewer(built: Path) -> None:
    lost = {"scores": None, "matrix": None, "milliseconds": 2000, "work": 1}
    assert followed(built, True, [*second_at_rest(), lost])["readings"][-1] is None
    far = [found(1.1 + i / 30, AT_REST, REST_TURN, (0.5, -0.4, -1)) for i in range(60)]
    assert np.abs(followed(built, False, second_at_rest() + far)["readings"][-1]["shift"]).max() <= 0.08
    values, step = np.random.default_rng(1).standard_normal(40), 1 / 30
    smooth = {"smoothing": {"rest": 1.5, "follow": 6}, "values": values.tolist(), "step": step}
    smoothed = followed(built, False, [], smooth=smooth)["smoothed"]
    smoother = OneEuro(np.array([1.5]), np.array([6.0]))
    expected = [smoother(np.array([value]), index * step)[0] for index, value in enumerate(values)]
    np.testing.assert_allclose(smoothed, expected, rtol=1e-9, atol=1e-12)
