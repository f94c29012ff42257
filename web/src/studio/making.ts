// Makes the avatar and takes it away: what is said of both, and the settings behind "More".

import { ask, person, type Settings } from "./api";
import { attempt, button, duration, fill, find, make, press } from "./page";
import { now, STAGES, STAGE_NAMES, words } from "./state";

const QUALITIES: Record<string, string> = { draft: "Draft: soon", standard: "Standard", fine: "Fine: twice as long" };

export function showMaking(): void {
  const { progress, films, settings } = now.whole!, { state, stage, seconds_left } = progress;
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
  start.textContent = state === "stopped" ? "Go on" : state === "failed" ? "Try again" : now.whole!.made ? "Make it again" : "Make the avatar";
  start.disabled = !films.some((each) => each.whole);
  start.classList.toggle("main", !now.whole!.made || state === "stopped" || state === "failed");
  fill("quality", now.listed.offered.qualities, () => now.listed.offered.qualities.map((value) => make("option", { value }, QUALITIES[value] ?? value)));
  fill("method", now.listed.offered.methods, () => now.listed.offered.methods.map((value) => make("option", { value }, value.replaceAll("_", " "))));
  if (find("more").dataset.of === now.whole!.name) return;
  find("more").dataset.of = now.whole!.name;
  find<HTMLSelectElement>("quality").value = settings.quality;
  find<HTMLSelectElement>("method").value = settings.method;
  find<HTMLInputElement>("shoulders").checked = settings.shoulders;
  find<HTMLInputElement>("threads").value = `${settings.threads}`;
  find<HTMLInputElement>("keep").checked = settings.keep_film;
}

export const settings = (): Settings => ({
  quality: find<HTMLSelectElement>("quality").value,
  method: find<HTMLSelectElement>("method").value,
  shoulders: find<HTMLInputElement>("shoulders").checked,
  threads: Math.round(Number(find<HTMLInputElement>("threads").value)) || 0,
  keep_film: find<HTMLInputElement>("keep").checked,
});

async function take(kind: string): Promise<void> {
  const { name, takings } = now.whole!;
  if (!takings.find((each) => each.kind === kind)?.ready) await ask("POST", person(name, "take", kind), {});
  make("a", { href: `${person(name, "take", kind)}?save`, download: "" }).click();
  await now.look();
}

export function showTakings(): void {
  const { takings, made, advice, progress } = now.whole!;
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
