// What a stranger does in pages, for first_minute.py, which puts these functions into every page before its own scripts.

const wait = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));
/** Share of the canvas that the head covers. It is drawn once more, since a canvas keeps its pixels for one picture only. */
function covered(viewer) {
  viewer.draw();
  const { width, height } = viewer.canvas, copy = new OffscreenCanvas(width, height).getContext("2d");
  copy.drawImage(viewer.canvas, 0, 0);
  const { data } = copy.getImageData(0, 0, width, height);
  let count = 0;
  for (let k = 3; k < data.length; k += 4) count += data[k] > 128;
  return count / (width * height);
}
const strayed = ({ avatar, face }) => Math.max(...face.expression.map((value, k) => Math.abs(value - avatar.neutral.expression[k])));

window.walk = {
  wait,
  /** Waits for the first picture, and says after how many seconds it came. */
  async first() {
    const viewer = await mien;
    await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
    const seconds = performance.now() / 1000;
    return { seconds, covered: covered(viewer) };
  },
  async later(milliseconds) {
    const viewer = await mien;
    await wait(milliseconds);
    return { covered: covered(viewer) };
  },
  /** Presses the button of a face. */
  async face(name) {
    const viewer = await mien, buttons = [...document.querySelectorAll("#faces button")];
    buttons.find((each) => each.textContent === name).click();
    // A face comes softly, and then stays.
    for (let before = NaN, moved = strayed(viewer); moved !== before; moved = strayed(viewer)) {
      before = moved;
      for (let k = 0; k < 4; ++k) await new Promise(requestAnimationFrame);
    }
    return { moved: strayed(viewer) };
  },
  /** Opens what is behind "More", with one group of sliders. */
  async more(group) {
    const more = document.getElementById("more");
    if (more.getAttribute("aria-expanded") === "false") more.click();
    const groups = [...document.querySelectorAll("#sliders details")];
    groups.forEach((each) => (each.open = each.querySelector("summary").textContent === group));
    groups.find((each) => each.open)?.scrollIntoView();
    await wait(500);
  },
  /** Presses "Be me", and lets the camera drive the face for some seconds. */
  async beMe(milliseconds) {
    const viewer = await mien, camera = await webcam, began = performance.now();
    document.getElementById("camera").click();
    while (camera.state !== "running" && performance.now() - began < 90000) await wait(50);
    const seconds = (performance.now() - began) / 1000;
    let moved = 0;
    for (const end = performance.now() + milliseconds; performance.now() < end; await wait(50)) moved = Math.max(moved, strayed(viewer));
    return { state: camera.state, seconds, moved };
  },
  /** Presses "Be me" where the camera is not allowed. */
  async denied() {
    const camera = await webcam, told = document.getElementById("camera-state");
    document.getElementById("camera").click();
    while (!told.textContent || camera.state !== "off") await wait(50);
  },
  /** Waits for the avatar of an element. */
  async element() {
    const avatar = document.querySelector("mien-avatar");
    if (!avatar.viewer) await new Promise((done) => avatar.addEventListener("load", done));
    await wait(1500);
    return { covered: covered(avatar.viewer) };
  },
};
