// Draws the conformance set by an engine, and compares its pictures with those of mien's own renderer.
import { readAny } from "mien-web";

const bytes = async (address) => {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(`${address}: the server answers ${answer.status}. Make the set first: python web/conformance/make.py --out web/conformance/set`);
  return answer;
};

/** The pixels of a picture by its address, four numbers each. */
async function pixels(address) {
  const bitmap = await createImageBitmap(await (await bytes(address)).blob(), { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  const canvas = new OffscreenCanvas(bitmap.width, bitmap.height), context = canvas.getContext("2d");
  context.drawImage(bitmap, 0, 0);
  return context.getImageData(0, 0, bitmap.width, bitmap.height).data;
}

/** How alike two pictures are, in dB. */
function likeness(first, second) {
  let sum = 0;
  for (let i = 0; i < first.length; ++i) if (i % 4 < 3) sum += ((first[i] - second[i]) / 255) ** 2;
  return -10 * Math.log10(sum / (0.75 * first.length));
}

/** The largest difference of two pixels' colours, or of a pixel and a colour, 0 to 1. */
const apart = (first, second, i, color) => Math.max(...[0, 1, 2].map((k) => Math.abs(first[i + k] - (color ? color[k] : second[i + k])) / 255));

/**
 * Runs the set at `base` by the adapter's `open` on a canvas.
 * @returns Rows { what, value, least, passed }: dB of each face and of two avatars, wrong pixels of boxes, and what an object of a scene does.
 */
export async function run(open, base, canvas, told = () => {}) {
  const set = await (await bytes(`${base}/set.json`)).json(), rows = [], { least } = set;
  canvas.width = canvas.height = set.side;
  const note = (what, value, limit, passed) => {
    rows.push({ what, value, least: limit, passed });
    told(rows.at(-1));
  };
  const host = await open(canvas, set.background), shot = async () => pixels(await host.draw());
  for (const [index, { file, faces }] of set.avatars.entries()) {
    const { avatar } = await readAny(new Uint8Array(await (await bytes(`${base}/${file}`)).arrayBuffer()));
    const one = host.add(avatar, [0, 0, 0]);
    for (const { face, eye, picture } of faces) {
      one.setFace(face);
      host.look(eye, set.target, set.fov);
      const value = likeness(await shot(), await pixels(`${base}/${picture}`));
      note(`${file}, ${JSON.stringify(face)}`, value, least.face, value >= least.face);
    }
    if (!index) {
      one.setFace({});
      host.look(faces[0].eye, set.target, set.fov);
      await boxes(host, one, set, `${base}/${faces[0].alpha}`, shot, note);
      const second = host.add(avatar, set.two.place);
      host.look(set.two.eye, set.target, set.fov);
      const value = likeness(await shot(), await pixels(`${base}/${set.two.picture}`));
      note("two avatars that overlap", value, least.two, value >= least.two);
      second.dispose();
      await life(host, one, avatar, set, shot, note);
    }
    one.dispose();
  }
  host.close();
  return rows;
}

/** A box before the head hides it, and a box behind it is hidden, at every pixel but the soft edge. */
async function boxes(host, one, set, alphas, shot, note) {
  const alone = await shot(), alpha = await pixels(alphas), color = set.box_color.map((x) => 255 * x), back = set.background.map((x) => 255 * x), { least } = set;
  for (const [name, { place, size }] of Object.entries(set.boxes)) {
    const box = host.box(place, size, set.box_color), both = await shot();
    let wrong = 0, seen = 0;
    for (let i = 0; i < both.length; i += 4) {
      const opaque = alpha[i] > 252, empty = alpha[i] === 0, changed = apart(both, alone, i) > least.box, boxed = apart(both, null, i, color) <= least.box;
      if (boxed) ++seen;
      if (name === "before" ? changed && !boxed : opaque ? changed : empty && !boxed && apart(both, null, i, back) > least.box) ++wrong;
    }
    note(`a box ${name} the head: wrong pixels, of ${seen} of the box`, wrong, 0, seen > 50 && wrong === 0);
    box.remove();
  }
}

/** It plays, looks aside, hides, hangs on a parent, and goes. */
async function life(host, one, avatar, set, shot, note) {
  const { eye, place } = set.two, back = set.background.map((x) => 255 * x), moved = (point) => point.map((x, axis) => x + place[axis]);
  const empty = (picture) => {
    let wrong = 0;
    for (let i = 0; i < picture.length; i += 4) if (apart(picture, null, i, back) > 0.01) ++wrong;
    return wrong;
  };
  one.setFace({ jawOpen: 0.8 });
  const wide = await shot(), { neutral } = avatar, faces = [neutral, one.face];
  const motion = { fps: 2, ...Object.fromEntries(Object.keys(one.face).map((name) => [name, Float32Array.from(faces.flatMap((face) => Array.from(face[name])))])) };
  one.setFace({});
  const rest = await shot();
  one.play(motion);
  one.update(0.6);
  const played = likeness(await shot(), wide), apartFaces = likeness(rest, wide);
  note("a motion plays: dB of its second face", played, 50, played >= 50 && apartFaces < 45);
  one.pause();
  one.setFace({});
  one.lookAt([1, 0.1, 0.5]);
  const aside = likeness(await shot(), rest);
  one.lookAt(null);
  const again = likeness(await shot(), rest);
  note("the eyes look aside and back: dB", again, 50, again >= 50 && aside < 50);
  host.hide(one, true);
  const hidden = empty(await shot());
  note("it hides: pixels left", hidden, 0, hidden === 0);
  host.hide(one, false);
  host.hang(one, place);
  host.look(moved(eye), moved(set.target), set.fov);
  const hung = likeness(await shot(), rest);
  note("it moves with its parent: dB", hung, 40, hung >= 40);
  one.dispose();
  const gone = empty(await shot());
  note("it goes: pixels left", gone, 0, gone === 0);
  one.dispose = () => {};
}
