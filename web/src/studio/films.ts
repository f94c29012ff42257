// The films of a person: their rows, what is sent, and the camera.

import { ask, endingOf, person, Sending, type Film } from "./api";
import { check, Filming } from "./filming";
import { attempt, button, find, make, press, say, sure } from "./page";
import { addRings } from "./rings";
import { showStage, webcam } from "./stage";
import { now } from "./state";

/** The films that this page is sending. */
export const sent = new Set<string>();
/** What would make each film better, by its name. */
export const checked = new Map<string, string[]>();
const video = () => find<HTMLVideoElement>("camera");
const fillRings = addRings(find("rings"));

export const sizeOf = (bytes: number) => (bytes < 1e6 ? `${Math.ceil(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(bytes < 1e7 ? 1 : 0)} MB`);

/** How far the film of a phone is. */
export function phoneWords(): string {
  const { phone, films } = now.whole!, film = films.find(({ name }) => name === phone?.film);
  if (!phone?.film) return "Waiting for the phone.";
  if (phone.done || !film || film.whole) return "The film has arrived.";
  const share = phone.size > 0 ? ` ${Math.floor((100 * film.size) / phone.size)} % of it is here.` : "";
  return film.coming ? `The film is coming.${share}` : `The phone has stopped sending.${share} Go on with its page, or with this code.`;
}

export function filmRow(name: string, film: Film, number: number): HTMLElement {
  const { seconds, width, height } = film.facts, better = checked.get(film.name);
  const about = film.whole ? [seconds && `${Math.round(seconds)} s`, width && `${width}×${height}`, sizeOf(film.size)].filter(Boolean).join(", ") : `${film.coming ? "is coming" : "unfinished"}, ${sizeOf(film.size)}`;
  const left = !film.whole && !film.coming && now.whole?.phone?.film === film.name ? "The phone has stopped sending. “From a phone” shows its code again, to go on." : "";
  const note = better ? (better.length ? better.slice(0, 3).join(" ") : "It has all that an avatar needs.") : left;
  const text = make("span", {}, `Film ${number}`, make("small", {}, about), ...(note ? [make("small", {}, note)] : []));
  if (film.coming) return make("li", {}, text);
  const remove = press("Remove", () => removeFilm(name, film, number), `Remove film ${number}`);
  if (!film.whole) return make("li", {}, text, press("Keep", () => keep(name, film.name), `Keep film ${number}`), remove);
  const play = press("Play", () => ((now.chosen = film.name), showStage()), `Play film ${number}`);
  const again = press("Check", () => checkFilm(name, film.name, person(name, "films", film.name)), `Check film ${number}`);
  return make("li", {}, text, play, ...(better ? [] : [again]), remove);
}

async function keep(name: string, film: string): Promise<void> {
  await ask("POST", person(name, "films", film), { cut: true });
  await now.look();
}

async function removeFilm(name: string, film: Film, number: number): Promise<void> {
  if (!(await sure(`Delete film ${number}?`, "The film is removed from this machine. An avatar that was made of it stays."))) return;
  await ask("DELETE", person(name, "films", film.name));
  now.chosen = "";
  await now.look();
}

export async function checkFilm(name: string, film: string, source: string): Promise<void> {
  const told = find("sending");
  told.hidden = false;
  try {
    const { missing, face } = await check(source, (share) => (told.textContent = `Looking through the film: ${Math.round(100 * share)} %`));
    checked.set(film, missing);
    if (face && now.whole?.name === name && !now.whole.face) await ask("PUT", person(name, "face"), face);
  } finally {
    told.hidden = true;
  }
  await now.look();
}

export async function send(file: File): Promise<void> {
  if (!now.whole) return;
  const { name } = now.whole, told = find("sending");
  told.hidden = false;
  let film = "";
  try {
    const [sending, begun] = await Sending.begin(name, endingOf(file.name));
    sent.add((film = begun));
    await sending.send(file, (sent) => (told.textContent = `${Math.round((100 * sent) / file.size)} % of ${sizeOf(file.size)}`));
    await ask("POST", person(name, "films", film), {});
    sent.delete(film);
    await now.look();
    const source = URL.createObjectURL(file);
    await attempt(() => checkFilm(name, film, source));
    URL.revokeObjectURL(source);
  } finally {
    sent.delete(film);
    told.hidden = true;
    await now.look();
  }
}

/** Opens the camera on the stage. */
export async function film(): Promise<void> {
  if (now.filming || !now.whole) return;
  webcam.stop();
  const own = (now.filming = new Filming(now.whole.name, video()));
  now.chosen = "";
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

export async function endFilm(keeps: boolean): Promise<void> {
  const own = now.filming;
  if (!own) return;
  now.filming = null;
  const missing = own.guide.missing();
  try {
    const made = await own.finish(keeps);
    if (made) checked.set(made, missing);
  } finally {
    sent.delete(own.film);
    own.close();
    showStage();
    await now.look();
  }
  button("make").focus();
}

export function closeCamera(): void {
  now.filming?.close();
  now.filming = null;
  showStage();
}
