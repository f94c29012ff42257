// The studio: the list of people, and for each: film, make, take away.

import { WORDS } from "../webcam";
import { ask, person, Refused, type Listed, type Short, type Whole } from "./api";
import { checked, checkFilm, closeCamera, endFilm, film, filmRow, phoneWords, send, sent } from "./films";
import { settings, showMaking, showTakings } from "./making";
import { attempt, busy, button, fill, find, make, on, press, say, sure } from "./page";
import { beMe, clearStage, showStage, webcam } from "./stage";
import { current, go, now, words } from "./state";

/** Milliseconds between two looks at what the server does, while something happens and otherwise. */
const SOON = 1000, LATER = 5000;

const faceOf = ({ name, face }: Short) =>
  face ? make("img", { className: "face", alt: "", src: `${person(name, "face")}?${face}` }) : make("span", { className: "face", ariaHidden: "true" }, [...name][0]);

const dateOf = (seconds: number) => new Date(1000 * seconds).toLocaleDateString(undefined, { dateStyle: "medium" });

function showList(): void {
  fill("people", now.listed.people, () =>
    now.listed.people.map((each) => {
      const card = press("", () => go(each.name), `${each.name}: ${words(each.progress)}`);
      card.append(faceOf(each), make("strong", {}, each.name), make("small", {}, words(each.progress)), make("small", {}, dateOf(each.changed)));
      return make("li", {}, card);
    }),
  );
  find("nobody").hidden = now.listed.people.length > 0;
}

function showPerson(): void {
  const { name, films } = now.whole!, focused = document.activeElement;
  if (find("title").textContent !== name) find("title").textContent = name;
  const rows = films.map((each, k) => ({ each, number: k + 1 })).filter(({ each }) => !sent.has(each.name));
  fill("films", [rows, [...checked], now.whole!.phone?.film], () => rows.map(({ each, number }) => filmRow(name, each, number)));
  for (const id of ["film", "choose", "from-phone"]) button(id).disabled = now.filming !== null;
  button("film").textContent = films.some((each) => each.whole) ? "Film more" : "Film";
  button("film").classList.toggle("main", !films.length);
  showMaking();
  showTakings();
  showStage();
  // What had the focus may have gone, such as “Stop” at the end of the making.
  if (focused instanceof HTMLElement && !focused.checkVisibility()) find("title").focus();
  const state = now.whole!.phone, told = find("phone-state"), words = phoneWords();
  if (told.textContent !== words) told.textContent = words;
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
    if (!name || !now.listed) now.listed = await ask<Listed>("GET", "/api/people");
    if (name) {
      const found = await ask<Whole>("GET", person(name));
      if (current() !== name) return;
      now.whole = found;
      soon = ["making", "waiting"].includes(found.progress.state) || (found.phone !== null && !found.phone.done);
    } else now.whole = null;
    for (const [id, shown] of [["people", !name], ["new", !name], ["person", Boolean(name)], ["home", Boolean(name)]] as const) find(id).hidden = !shown;
    if (name) showPerson();
    else {
      find("title").textContent = `mien studio · ${now.listed.folder}`;
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
  if (!now.listed.offered.lan) return say("Phones reach this studio if it is started with --lan: mien studio DIR --lan");
  const { url, svg } = await ask<{ url: string; svg: string }>("POST", person(now.whole!.name, "phone"), {});
  const drawn = new DOMParser().parseFromString(svg, "text/html").body.firstElementChild!;
  find("code").replaceChildren(drawn, make("code", {}, url));
  find<HTMLDialogElement>("phone").showModal();
  await look();
}

async function remove(): Promise<void> {
  const { name } = now.whole!;
  if (!(await sure(`Delete ${name}?`, "The films, the avatar and all files of this person are removed from this machine. What you have taken away stays where you saved it."))) return;
  closeCamera();
  await ask("DELETE", person(name));
  go("");
}

function connect(): void {
  const start = (id: string, act: () => unknown) => button(id).addEventListener("click", () => void busy(button(id), act));
  on("home", "click", () => go(""));
  on("new", "click", () => find<HTMLDialogElement>("adding").showModal());
  on("not-adding", "click", () => find<HTMLDialogElement>("adding").close());
  on("add", "submit", add);
  start("film", film);
  start("record", async () => {
    await now.filming?.record(!now.whole?.face);
    if (now.filming) sent.add(now.filming.film);
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
  on("phone", "close", () => now.whole && !now.whole.phone?.film && ask("DELETE", person(now.whole.name, "phone")));
  start("make", async () => {
    webcam.stop();
    now.chosen = "";
    await ask("POST", person(now.whole!.name, "making"), settings());
    await look();
    button("stop").focus();
  });
  start("stop", async () => {
    await ask("DELETE", person(now.whole!.name, "making"));
    await look();
    button("make").focus();
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
    clearStage();
    checked.clear();
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
}

now.look = look;
connect();
void look();
