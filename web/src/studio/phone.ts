// The page that a phone opens by the QR code: it films with the phone's own camera application, and sends one film.

import { ask, endingOf, Sending } from "./api";
import { button, find } from "./page";

const told = (text: string) => (find("told").textContent = text);

async function send(file: File): Promise<void> {
  const share = find<HTMLProgressElement>("share"), open = button("open");
  open.disabled = true;
  share.hidden = false;
  try {
    await ask("POST", "begin", { ending: endingOf(file.name) || (file.type.includes("quicktime") ? "mov" : "mp4") });
    const sending = Sending.at((at) => `piece?at=${at}`);
    await sending.send(file, (sent) => {
      share.value = (100 * sent) / file.size;
      told(`${Math.floor(share.value)} % is sent. Keep this page open.`);
    });
    await ask("POST", "done", {});
    told("The film has arrived. You can put the phone away.");
    open.hidden = share.hidden = true;
  } catch (error) {
    told((error as Error).message);
    open.disabled = false;
  }
}

find("open").addEventListener("click", () => find("file").click());
find<HTMLInputElement>("file").addEventListener("change", () => {
  const [file] = find<HTMLInputElement>("file").files ?? [];
  if (file) void send(file);
});
