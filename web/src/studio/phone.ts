// The page that a phone opens by the QR code: it films with the phone's own camera application, and sends one film.

import { ask, endingOf, Refused, Sending } from "./api";
import { button, find } from "./page";

const told = (text: string) => (find("told").textContent = text);
/** The film that did not arrive; the next press sends the rest of it. */
let unsent: File | null = null;

async function send(file: File): Promise<void> {
  const share = find<HTMLProgressElement>("share"), open = button("open");
  open.disabled = true;
  share.hidden = false;
  try {
    const ending = endingOf(file.name) || (file.type.includes("quicktime") ? "mov" : "mp4");
    const { at } = await ask<{ at: number }>("POST", "begin", { ending, size: file.size });
    const sending = Sending.at((from) => `piece?at=${from}`, at);
    await sending.send(file.slice(at), (sent) => {
      share.value = (100 * sent) / file.size;
      told(`${Math.floor(share.value)} % is sent. Keep this page open.`);
    });
    await ask("POST", "done", {});
    told("The film has arrived. You can put the phone away.");
    open.hidden = share.hidden = true;
  } catch (error) {
    const cut = error instanceof Refused && error.status === 0;
    unsent = cut ? file : null;
    open.textContent = cut ? "Go on sending" : "Open the camera";
    told(cut ? "The computer does not answer. What it has of the film stays there. Join its network again, then go on." : (error as Error).message);
    open.disabled = false;
  }
}

find("open").addEventListener("click", () => (unsent ? void send(unsent) : find("file").click()));
find<HTMLInputElement>("file").addEventListener("change", () => {
  const [file] = find<HTMLInputElement>("file").files ?? [];
  if (file) void send(file);
});
