// The studio: the list of people, and for each: film, make, take away.

import { addTurning, fit } from "../controls";
import { readMien } from "../format";
import { Viewer } from "../viewer";
import { Webcam, WORDS } from "../webcam";
import { ask, endingOf, person, Refused, Sending, type Film, type Listed, type Progress, type Settings, type Short, type Whole } from "./api";
import { check, Filming, PARTS } from "./filming";
import { attempt, busy, button, duration, fill, find, make, on, press, say } from "./page";
import { addRings } from "./rings";

/** Milliseconds between two looks at what the server does, while something happens and otherwise. */
const SOON = 1000, LATER = 5000;
const STAGES = ["capture", "tracking", "alignment", "training", "scoring"];
const STAGE_NAMES: Record<string, string> = { capture: "Frames", tracking: "Face", alignment: "Sharpness", training: "Avatar", scoring: "Score" };
const QUALITIES: Record<string, string> = { draft: "Draft: soon", standard: "Standard", fine: "Fine: twice as long" };

let listed: Listed;
let whole: Whole | null = null;
let filming: Filming | null = null;
let fillRings: ReturnType<typeof addRings>;
let viewer: Viewer | null = null;
/** Address of the avatar on the stage's canvas. */
let shown = "";
/** The film that the stage shows; empty if none was chosen. */
let chosen = "";
/** The camera that drives the avatar. */
const webcam = new Webcam(() => PARTS);
let detach = () => {};
/** The films that this page is sending. */
const sent = new Set<string>();
/** What would make each film better, by its name. */
const checked = new Map<string, string[]>();
const video = () => find<HTMLVideoElement>("camera");

/** The person of the address, #NAME. */
const current = () => decodeURIComponent(location.hash.slice(1));
const go = (name: string) => (location.hash = encodeURIComponent(name));

function words({ state, stage, before }: Progress): string {
  const at = stage?.name ? ` at “${STAGE_NAMES[stage.name] ?? stage.name}”` : "";
  const told = { new: "Not made yet", waiting: `Waits for ${before === 1 ? "one other" : `${before} others`}`, making: `Is being made${at}`, stopped: `Stopped${at}`, failed: "Failed", done: "Done" };
  return told[state];
}

const faceOf = ({ name, face }: Short) =>
  face ? make("img", { className: "face", alt: "", src: `${person(name, "face")}?${face}` }) : make("span", { className: "face", ariaHidden: "true" }, [...name][0]);

const dateOf = (seconds: number) => new Date(1000 * seconds).toLocaleDateString(undefined, { dateStyle: "medium" });

function showList(): void {
  fill("people", listed.people, () =>
    listed.people.map((each) => {
      const card = press("", () => go(each.name), `${each.name}: ${words(each.progress)}`);
      card.append(faceOf(each), make("strong", {}, each.name), make("small", {}, words(each.progress)), make("small", {}, dateOf(each.changed)));
      return make("li", {}, card);
    }),
  );
  find("nobody").hidden = listed.people.length > 0;
}

const sizeOf = (bytes: number) => (bytes < 1e6 ? `${Math.ceil(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(bytes < 1e7 ? 1 : 0)} MB`);

function filmRow(name: string, film: Film, number: number): HTMLElement {
  const { seconds, width, height } = film.facts, better = checked.get(film.name);
  const about = film.whole ? [seconds && `${Math.round(seconds)} s`, width && `${width}×${height}`, sizeOf(film.size)].filter(Boolean).join(", ") : `${film.coming ? "is coming" : "unfinished"}, ${sizeOf(film.size)}`;
  const note = better && (better.length ? better.slice(0, 3).join(" ") : "It has all that an avatar needs.");
  const text = make("span", {}, `Film ${number}`, make("small", {}, about), ...(note ? [make("small", {}, note)] : []));
  if (film.coming) return make("li", {}, text);
  const remove = press("Remove", () => removeFilm(name, film, number), `Remove film ${number}`);
  if (!film.whole) return make("li", {}, text, press("Keep", () => keep(name, film.name), `Keep film ${number}`), remove);
  const play = press("Play", () => ((chosen = film.name), showStage()), `Play film ${number}`);
  const again = press("Check", () => checkFilm(name, film.name, person(name, "films", film.name)), `Check film ${number}`);
  return make("li", {}, text, play, ...(better ? [] : [again]), remove);
}

async function keep(name: string, film: string): Promise<void> {
  await ask("POST", person(name, "films", film), {});
  await look();
}

async function removeFilm(name: string, film: Film, number: number): Promise<void> {
  if (!(await sure(`Delete film ${number}?`, "The film is removed from this machine. An avatar that was made of it stays."))) return;
  await ask("DELETE", person(name, "films", film.name));
  chosen = "";
  await look();
}

async function checkFilm(name: string, film: string, source: string): Promise<void> {
  const told = find("sending");
  told.hidden = false;
  try {
    const { missing, face } = await check(source, (share) => (told.textContent = `Looking through the film: ${Math.round(100 * share)} %`));
    checked.set(film, missing);
    if (face && whole?.name === name && !whole.face) await ask("PUT", person(name, "face"), face);
  } finally {
    told.hidden = true;
  }
  await look();
}

async function send(file: File): Promise<void> {
  if (!whole) return;
  const { name } = whole, told = find("sending");
  told.hidden = false;
  let film = "";
  try {
    const [sending, begun] = await Sending.begin(name, endingOf(file.name));
    sent.add((film = begun));
    await sending.send(file, (sent) => (told.textContent = `${Math.round((100 * sent) / file.size)} % of ${sizeOf(file.size)}`));
    await ask("POST", person(name, "films", film), {});
    sent.delete(film);
    await look();
    const source = URL.createObjectURL(file);
    await attempt(() => checkFilm(name, film, source));
    URL.revokeObjectURL(source);
  } finally {
    sent.delete(film);
    told.hidden = true;
    await look();
  }
}

/** Opens the camera on the stage. */
async function film(): Promise<void> {
  if (filming || !whole) return;
  webcam.stop();
  const own = (filming = new Filming(whole.name, video()));
  chosen = "";
  fillRings(own.guide);
  showStage();
  find("request").textContent = "Opening the camera. Allow it if the browser asks.";
  find("clock").textContent = "";
  button("record").disabled = true;
  own.onEnd = (why) => void attempt(async () => {
    say(why, 20);
    await endFilm(true);
  });
  own.onSeen = () => showGuide(own);
  try {
    await own.open();
    find("request").textContent = "Put your face into the outline, then record.";
  } catch (error) {
    closeCamera();
    throw error;
  }
  showStage();
  button("record").disabled = false;
  button("record").focus();
}

function showGuide(own: Filming): void {
  const { guide, recording } = own, { fault } = guide, told = find("fault");
  fillRings(guide);
  told.hidden = !fault;
  if (fault && told.dataset.words !== fault.words) told.replaceChildren(fault.words, make("span", {}, fault.remedy));
  told.dataset.words = fault?.words ?? "";
  if (!recording) return;
  if (find("request").textContent !== guide.request) find("request").textContent = guide.request;
  const saved = own.sent ? ` · ${sizeOf(own.sent)} saved` : "";
  find("clock").textContent = `0:${`${Math.floor(guide.seconds)}`.padStart(2, "0")}${saved}`;
  if (guide.done) void attempt(() => endFilm(true));
}

async function endFilm(keeps: boolean): Promise<void> {
  const own = filming;
  if (!own) return;
  filming = null;
  const missing = own.guide.missing();
  try {
    const made = await own.finish(keeps);
    if (made) checked.set(made, missing);
  } finally {
    sent.delete(own.film);
    own.close();
    showStage();
    await look();
  }
  button("make").focus();
}

function closeCamera(): void {
  filming?.close();
  filming = null;
  showStage();
}

/** Shows on the stage what there is: the camera, a film, the living avatar, the growing one, or nothing yet. */
function showStage(): void {
  if (!whole) return;
  const { name, progress, made } = whole, making = progress.state === "making";
  const driven = webcam.state !== "off", living = made && !making ? person(name, "take", "page") : "";
  const shows = filming ? "camera" : driven ? "grown" : chosen ? "review" : living ? "living" : making && whole.growing ? "grown" : making && whole.fit && progress.stage?.name === "tracking" ? "fit" : whole.face ? "poster" : "empty";
  for (const id of ["review", "living", "grown", "fit", "poster", "empty"]) find(id).hidden = id !== shows;
  for (const id of ["camera", "rings", "bar"]) find(id).toggleAttribute("hidden", shows !== "camera");
  find("words").hidden = !filming && !driven;
  const recording = filming?.recording ?? false;
  button("record").hidden = recording;
  button("finish").hidden = !recording;
  button("cancel").textContent = recording ? "Throw away" : "Close the camera";
  if (!filming) find("fault").hidden = true;
  show<HTMLVideoElement>("review", shows === "review" ? person(name, "films", chosen) : "");
  show<HTMLIFrameElement>("living", shows === "living" ? `${living}?${whole.changed}` : "");
  show<HTMLIFrameElement>("fit", shows === "fit" ? `${person(name, "fit")}?${whole.fit}` : "");
  show<HTMLImageElement>("poster", shows === "poster" ? `${person(name, "face")}?${whole.face}` : "");
  find("poster").classList.toggle("developing", making);
  if (shows === "grown" && !driven) void attempt(() => showAvatar(`${person(name, "growing")}?${whole!.growing}`));
}

/** Sets what a frame, a picture or a film shows, unless it shows that already. */
function show<T extends HTMLElement & { src: string }>(id: string, source: string): void {
  const place = find<T>(id);
  if ((place.getAttribute("src") ?? "") === source) return;
  if (source) place.src = source;
  else place.removeAttribute("src");
}

/** Shows an avatar on the stage's canvas, in the view that was chosen for the last one. */
async function showAvatar(address: string): Promise<void> {
  if (address === shown) return;
  shown = address;
  const answer = await fetch(address);
  if (!answer.ok) return;
  const canvas = find<HTMLCanvasElement>("grown"), { yaw, pitch, zoom } = viewer ?? { yaw: 0, pitch: 0, zoom: 1 };
  const next = readMien(await answer.arrayBuffer());
  viewer?.dispose();
  const fresh = canvas.cloneNode() as HTMLCanvasElement;
  canvas.replaceWith(fresh);
  viewer = new Viewer(fresh, next);
  Object.assign(viewer, { yaw, pitch, zoom });
  addTurning(viewer, fresh);
  fit(viewer);
  viewer.look();
}

/** Lets the avatar follow the face in front of the camera, or ends that. */
async function beMe(): Promise<void> {
  if (webcam.state !== "off") return webcam.stop();
  const { name, takings } = whole!;
  if (!takings.find(({ kind }) => kind === "mien")?.ready) await ask("POST", person(name, "take", "mien"), {});
  chosen = "";
  const starting = webcam.start();
  showStage();
  await Promise.all([starting, showAvatar(person(name, "take", "mien"))]);
  detach();
  detach = webcam.attach(viewer!);
}

function showMaking(): void {
  const { progress, films, settings } = whole!, { state, stage, seconds_left } = progress;
  const going = state === "making" || state === "waiting";
  find("progress").hidden = !going;
  fill("stages", [state, stage?.name], () => STAGES.map((name) => {
    const item = make("li", {}, STAGE_NAMES[name]);
    if (name === stage?.name) item.setAttribute("aria-current", "step");
    return item;
  }));
  const share = find<HTMLProgressElement>("share");
  if (state === "making" && stage?.percent != null) share.value = stage.percent;
  else share.removeAttribute("value");
  const left = state === "waiting" ? words(progress) : seconds_left === null ? "How long it takes is known soon" : `About ${duration(seconds_left)} left`;
  if (find("left").textContent !== left) find("left").textContent = left;
  const stopped = find("stopped");
  stopped.hidden = state !== "stopped" && state !== "failed";
  stopped.className = state === "failed" ? "bad" : "soft";
  stopped.textContent = state === "failed" ? `It failed: ${progress.error}` : `${words(progress)}. It goes on from there.`;
  const start = button("make");
  find("making").hidden = going;
  start.textContent = state === "stopped" ? "Go on" : state === "failed" ? "Try again" : whole!.made ? "Make it again" : "Make the avatar";
  start.disabled = !films.some((each) => each.whole);
  start.classList.toggle("main", !whole!.made || state === "stopped" || state === "failed");
  fill("quality", listed.offered.qualities, () => listed.offered.qualities.map((value) => make("option", { value }, QUALITIES[value] ?? value)));
  fill("method", listed.offered.methods, () => listed.offered.methods.map((value) => make("option", { value }, value.replaceAll("_", " "))));
  if (find("more").dataset.of === whole!.name) return;
  find("more").dataset.of = whole!.name;
  find<HTMLSelectElement>("quality").value = settings.quality;
  find<HTMLSelectElement>("method").value = settings.method;
  find<HTMLInputElement>("threads").value = `${settings.threads}`;
  find<HTMLInputElement>("keep").checked = settings.keep_film;
}

const settings = (): Settings => ({
  quality: find<HTMLSelectElement>("quality").value,
  method: find<HTMLSelectElement>("method").value,
  threads: Math.round(Number(find<HTMLInputElement>("threads").value)) || 0,
  keep_film: find<HTMLInputElement>("keep").checked,
});

async function take(kind: string): Promise<void> {
  const { name, takings } = whole!;
  if (!takings.find((each) => each.kind === kind)?.ready) await ask("POST", person(name, "take", kind), {});
  make("a", { href: `${person(name, "take", kind)}?save`, download: "" }).click();
  await look();
}

function showTakings(): void {
  const { takings, made, advice, progress } = whole!;
  find("take").hidden = !made || progress.state === "making";
  fill("takings", takings, () =>
    takings.map(({ kind, title, opens }) => {
      const save = press("Save", async () => {
        save.textContent = "Preparing …";
        await attempt(() => take(kind));
        save.textContent = "Save";
      }, `Save: ${title}`);
      return make("li", {}, make("span", {}, title, make("small", {}, opens)), save);
    }),
  );
  find("better").hidden = !advice.length;
  fill("advice", advice, () => advice.map((each) => make("li", {}, make("span", {}, each))));
}

function showPerson(): void {
  const { name, films } = whole!;
  if (find("title").textContent !== name) find("title").textContent = name;
  const rows = films.map((each, k) => ({ each, number: k + 1 })).filter(({ each }) => !sent.has(each.name));
  fill("films", [rows, [...checked]], () => rows.map(({ each, number }) => filmRow(name, each, number)));
  for (const id of ["film", "choose", "from-phone"]) button(id).disabled = filming !== null;
  button("film").textContent = films.some((each) => each.whole) ? "Film more" : "Film";
  button("film").classList.toggle("main", !films.length);
  showMaking();
  showTakings();
  showStage();
  const state = whole!.phone, told = find("phone-state");
  told.textContent = !state?.film ? "Waiting for the phone." : state.done ? "The film has arrived." : "The film is coming.";
  if (state?.done && find<HTMLDialogElement>("phone").open) {
    find<HTMLDialogElement>("phone").close();
    void attempt(() => ask("DELETE", person(name, "phone")));
    const newest = films.filter((each) => each.whole).pop();
    if (newest) void attempt(() => checkFilm(name, newest.name, person(name, "films", newest.name)));
  }
}

let waiting = 0;
/** Looks at what the server says, and shows it. */
async function look(): Promise<void> {
  clearTimeout(waiting);
  let soon = false;
  try {
    const name = current();
    if (!name || !listed) listed = await ask<Listed>("GET", "/api/people");
    if (name) {
      const found = await ask<Whole>("GET", person(name));
      if (current() !== name) return;
      whole = found;
      soon = ["making", "waiting"].includes(found.progress.state) || found.phone !== null;
    } else whole = null;
    for (const [id, shown] of [["people", !name], ["new", !name], ["person", Boolean(name)], ["home", Boolean(name)]] as const) find(id).hidden = !shown;
    if (name) showPerson();
    else {
      find("title").textContent = `mien studio · ${listed.folder}`;
      showList();
    }
    if (name) find("nobody").hidden = true;
  } catch (error) {
    say((error as Error).message);
    if (error instanceof Refused && error.status === 404) go("");
  } finally {
    clearTimeout(waiting);
    waiting = window.setTimeout(look, soon ? SOON : LATER);
  }
}

function sure(title: string, text: string): Promise<boolean> {
  const dialog = find<HTMLDialogElement>("sure");
  find("sure-title").textContent = title;
  find("sure-words").textContent = text;
  dialog.returnValue = "no";
  dialog.showModal();
  return new Promise((done) => dialog.addEventListener("close", () => done(dialog.returnValue === "yes"), { once: true }));
}

async function add(event: Event): Promise<void> {
  event.preventDefault();
  const refused = find("refused");
  refused.hidden = true;
  try {
    const { name } = await ask<{ name: string }>("POST", "/api/people", { name: find<HTMLInputElement>("name").value, agreed: find<HTMLInputElement>("agreed").checked });
    find<HTMLDialogElement>("adding").close();
    find<HTMLFormElement>("add").reset();
    go(name);
  } catch (error) {
    refused.hidden = false;
    refused.textContent = (error as Error).message;
  }
}

async function invite(): Promise<void> {
  if (!listed.offered.lan) return say("Phones reach this studio if it is started with --lan: mien studio DIR --lan");
  const { url, svg } = await ask<{ url: string; svg: string }>("POST", person(whole!.name, "phone"), {});
  const drawn = new DOMParser().parseFromString(svg, "text/html").body.firstElementChild!;
  find("code").replaceChildren(drawn, make("code", {}, url));
  find<HTMLDialogElement>("phone").showModal();
  await look();
}

async function remove(): Promise<void> {
  const { name } = whole!;
  if (!(await sure(`Delete ${name}?`, "The films, the avatar and all files of this person are removed from this machine. What you have taken away stays where you saved it."))) return;
  closeCamera();
  await ask("DELETE", person(name));
  go("");
}

function connect(): void {
  fillRings = addRings(find("rings"));
  const start = (id: string, act: () => unknown) => button(id).addEventListener("click", () => void busy(button(id), act));
  on("home", "click", () => go(""));
  on("new", "click", () => find<HTMLDialogElement>("adding").showModal());
  on("not-adding", "click", () => find<HTMLDialogElement>("adding").close());
  on("add", "submit", add);
  start("film", film);
  start("record", async () => {
    await filming?.record(!whole?.face);
    if (filming) sent.add(filming.film);
    showStage();
    button("finish").focus();
  });
  start("finish", () => endFilm(true));
  start("cancel", () => endFilm(false));
  start("choose", () => find("file").click());
  on("file", "change", async () => {
    const input = find<HTMLInputElement>("file"), [file] = input.files ?? [];
    if (file) await send(file);
    input.value = "";
  });
  start("from-phone", invite);
  on("no-phone", "click", () => find<HTMLDialogElement>("phone").close());
  on("phone", "close", () => whole && !whole.phone?.film && ask("DELETE", person(whole.name, "phone")));
  start("make", async () => {
    webcam.stop();
    chosen = "";
    await ask("POST", person(whole!.name, "making"), settings());
    await look();
  });
  start("stop", async () => {
    await ask("DELETE", person(whole!.name, "making"));
    await look();
  });
  start("be-me", beMe);
  start("neutral", () => webcam.calibrate());
  webcam.onState = (state, why) => {
    if (why) say(why);
    button("be-me").textContent = state === "off" ? "Be me" : "Stop";
    button("neutral").hidden = state === "off";
    find("request").textContent = WORDS[state];
    showStage();
  };
  start("delete", remove);
  addEventListener("hashchange", () => {
    closeCamera();
    webcam.stop();
    chosen = shown = "";
    checked.clear();
    viewer?.dispose();
    viewer = null;
    // Who reads by ear or walks by keys begins at the top of what is new.
    void look().then(() => find("title").focus());
  });
  const stage = find("person");
  stage.addEventListener("dragover", (event) => (event.preventDefault(), stage.classList.add("over")));
  stage.addEventListener("dragleave", () => stage.classList.remove("over"));
  stage.addEventListener("drop", (event) => {
    event.preventDefault();
    stage.classList.remove("over");
    const file = event.dataTransfer?.files[0];
    if (file) void attempt(() => send(file));
  });
  addEventListener("resize", () => viewer && fit(viewer));
}

connect();
void look();
