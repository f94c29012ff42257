// What `mien export --microphone` adds to the page: a button, after which the lips follow one's voice.

import { Microphone, MicrophoneError } from "./microphone";
import type { Viewer } from "./viewer";

/** How long a line stays, in milliseconds. */
const STAYS = 9000;
const find = (id: string) => document.getElementById(id)!;

function addMicrophone(viewer: Viewer): Microphone {
  const { content } = find("microphone-template") as HTMLTemplateElement, [button, told] = content.children as unknown as HTMLElement[];
  find("more").before(button);
  find("faces").before(told);
  const microphone = new Microphone(viewer);
  let clearing = 0;
  const tell = (text = "") => {
    told.textContent = text;
    clearTimeout(clearing);
    clearing = window.setTimeout(() => (told.textContent = ""), STAYS);
  };
  microphone.onState = (on, why) => {
    button.setAttribute("aria-pressed", `${on}`);
    tell(why ?? (on ? "Speak: the lips follow your voice. The sound stays in this page." : ""));
  };
  button.addEventListener("click", async () => {
    if (microphone.on) return microphone.stop();
    viewer.play(false);
    viewer.onMotion();
    try {
      await microphone.start();
    } catch (error) {
      tell(error instanceof MicrophoneError ? error.message : `${error}`);
    }
  });
  return microphone;
}

const page = window as unknown as { mien: Promise<Viewer>; microphone: Promise<Microphone> };
/** Scripts of the page reach the microphone by `await microphone`. */
page.microphone = page.mien.then(addMicrophone);
