"""A webcam in the exported page: a drawn head drives it, and nothing leaves the page."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from mien.export import find_webcam_files, write_packed, write_page
from mien.export.webcam import VERSION
from web_case import WEB, browse, drawn_head, script, served, tasks_vision, violations
from webcam_case import CAMERA, STILL, TRUE, Clip, draw_clip

FAKE = "--use-fake-device-for-media-stream"
ALLOWED = "--use-fake-ui-for-media-stream"
WINDOW = (640, 320)
CORRELATION = 0.9


@pytest.fixture(scope="module")
def clip() -> Clip:
    return draw_clip()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with few Gaussians, which are drawn soon."""
    tasks_vision()
    path = tmp_path_factory.mktemp("page") / "me.html"
    write_page(path, drawn_head(150), webcam=find_webcam_files())
    return path


RECORD = """(async () => {
  const viewer = await mien, camera = await webcam, { video, onState } = camera, [frames, names] = GIVEN;
  const log = { faces: [], states: [] }, button = document.getElementById("camera");
  const columns = names.map((name) => viewer.avatar.expression_names.indexOf(name));
  const until = async (ready) => { while (!ready()) await new Promise((done) => setTimeout(done, 20)); };
  camera.onState = (state, why) => (onState(state, why), log.states.push(state));
  document.getElementById("mirrored").click();
  button.click();
  await until(() => camera.state === "calibrating");
  // The automatic neutral face may be any; the button takes that of the still part.
  for (const frame of frames.slice(-8)) await film(frame);
  document.getElementById("neutral").click();
  for (const frame of frames) {
    await film(frame);
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
  button.click();
  await until(() => camera.state === "calibrating");
  for (const frame of frames.slice(0, 6)) await film(frame);
  camera.stop();
  return log;
})()"""


@pytest.mark.unchecked
def test_a_drawn_head_drives_jaw_and_blinks(page: Path, clip: Clip) -> None:
    """Coefficients of the avatar against the true ones of each picture. A hidden page stops, and starts again."""
    given = json.dumps([clip.pictures, TRUE])
    told = browse(page, [RECORD.replace("GIVEN", given)], WINDOW, flags=[FAKE, ALLOWED], opening=CAMERA)
    (log,) = told["results"]
    assert told["messages"] == []
    # The worker's script and two scripts of MediaPipe, all from the page's own memory.
    assert {address.partition(":")[0] for address in told["requests"]} <= {"blob", "data"}
    assert log["states"] == [*["opening", "calibrating", "running", "calibrating", "running", "off"],
                             *["opening", "calibrating", "running", "off"]]  # fmt: skip
    assert log["ended"] == [False, True]
    assert log["text"] == "The camera is off, because the page was hidden."
    assert log["rested"] is True
    assert log["label"] == "Be me"
    turned, *driven = np.array(log["faces"]).T
    for truth, shown, name in zip(clip.truth.T, driven, TRUE, strict=True):
        assert np.corrcoef(truth[STILL:], shown[STILL:])[0, 1] >= CORRELATION, name
        assert np.abs(shown[6:STILL]).mean() < 0.1, name
        assert shown[STILL:].max() > 0.7 * truth.max(), name
    turned = turned[STILL:] - float(drawn_head(1).neutral.head_rotation[1])
    assert np.corrcoef(clip.yaw[STILL:], turned)[0, 1] >= CORRELATION
    assert np.polyfit(clip.yaw[STILL:], turned, 1)[0] == pytest.approx(1, abs=0.3)


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
NOTICES = """
  document.getElementById("more").click();
  const notices = document.getElementById("notices");
  notices.open = true;
  return [notices.innerText, notices.querySelector("pre").getBoundingClientRect().height];
"""
CONTROLS = """
  (await webcam).onState("running");
  const controls = document.querySelectorAll("#camera-controls button, #camera-controls input");
  return [...controls].map((control) => [control.id, control.tabIndex, control.offsetParent !== null,
    (control.labels?.[0]?.textContent ?? control.textContent).trim()]);
"""
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
    """The page says what to do, names its controls and the licences of what it embeds, and forbids every way out."""
    presses = [script(PRESS.replace("NAME", json.dumps(name))) for name in WRONG]
    told = browse(page, [*presses, script(NOTICES), script(CONTROLS), TRY_TO_SEND], (900, 900))
    *pressed, (notices, height), controls, refused = told["results"]
    for (text, label, role, state), message in zip(pressed, WRONG.values(), strict=True):
        assert text.startswith(message)
        assert (label, role, state) == ("Be me", "status", "off")
    named = ["MediaPipe Authors", f"vision {VERSION}", "TensorFlow", "OpenCV", "XNNPACK", "Protocol Buffers",
             "Emscripten", "Apache License\n", "BSD 3-Clause License", "MIT License"]  # fmt: skip
    assert [part for part in named if part not in notices] == []
    assert height > 50
    assert controls == [
        ["neutral", 0, True, "This is my neutral face"],
        ["mirrored", 0, True, "Mirrored"],
        ["preview", 0, True, "My picture"],
    ]
    assert refused == ["connect-src", "form-action", "frame-src", "img-src", "script-src-elem"]
    assert set(told["requests"]) <= {"https://example.com/"}, "those that the last script tries, and the page refuses"


@pytest.mark.parametrize("device", [[], ["dark", "touch"]])
def test_everybody_can_use_the_page(page: Path, device: list[str]) -> None:
    """axe-core finds no fault in the page with its camera's controls and notices."""
    first = 'await webcam; document.getElementById("more").click();'
    assert violations(page, (390, 700), device, first) == []


CLASS = """
  const avatar = document.querySelector("mien-avatar"), told = document.querySelector("span"), [rest, open] = GIVEN;
  const until = async (ready) => { while (!ready()) await new Promise((done) => setTimeout(done, 20)); };
  await until(() => avatar.viewer);
  document.querySelector("button").click();
  await until(() => /fetched|second|calibrating/.test(told.textContent));
  if (told.textContent.includes("fetched")) return [told.textContent];
  const jaw = avatar.viewer.avatar.expression_names.indexOf("jawOpen"), { expression } = avatar.viewer.face;
  const jaws = [];
  for (const frame of [rest, open, rest]) {
    for (let k = 0; k < 8; ++k) await film(frame);
    jaws.push(expression[jaw]);
  }
  return [told.textContent, jaws];
"""


@pytest.mark.unchecked
def test_the_class_drives_the_element(tmp_path: Path, built: Path, clip: Clip, test_data: Path) -> None:
    """The example page, from a web server, with files of the package and the model beside it."""
    write_packed(tmp_path / "me.packed", drawn_head(150))
    for name in ("element.js", "webcam.js"):
        shutil.copy(built / name, tmp_path)
    shutil.copy(WEB / "examples" / "webcam.html", tmp_path / "index.html")
    (tmp_path / "tasks-vision").symlink_to(tasks_vision())
    given = json.dumps([clip.pictures[0], clip.pictures[int(clip.truth[:, 0].argmax())]])
    steps, flags = [script(CLASS.replace("GIVEN", given))], [FAKE, ALLOWED]
    with served(tmp_path) as address:
        without = browse(f"{address}/index.html", steps, WINDOW, flags=flags, opening=CAMERA)
        (tmp_path / "face_landmarker.task").symlink_to(test_data / "mediapipe" / "face_landmarker.task")
        told = browse(f"{address}/index.html", steps, WINDOW, flags=flags, opening=CAMERA)
    assert without["results"] == [["face_landmarker.task cannot be fetched: the server answers 404."]]
    state, (rest, open_, again) = told["results"][0]
    assert state == "running"
    assert max(rest, again) < 0.1 < 0.25 < open_
    assert all(request.startswith((address, "blob:", "data:")) for request in told["requests"])
