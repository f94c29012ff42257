// What the page knows: the people, the person of the address, and what is shown of them.

import type { Listed, Progress, Whole } from "./api";
import type { Filming } from "./filming";

export const STAGES = ["capture", "tracking", "alignment", "training", "scoring"];
export const STAGE_NAMES: Record<string, string> = { capture: "Frames", tracking: "Face", alignment: "Sharpness", training: "Avatar", scoring: "Score" };

export const now = {
  listed: null as unknown as Listed,
  whole: null as Whole | null,
  /** The camera, while it is open. */
  filming: null as Filming | null,
  /** The film that the stage shows; empty if none was chosen. */
  chosen: "",
  /** Asks the server, and shows what it says. */
  look: async () => {},
};

/** The person of the address, #NAME. */
export const current = () => decodeURIComponent(location.hash.slice(1));
export const go = (name: string) => (location.hash = encodeURIComponent(name));

export function words({ state, stage, before }: Progress): string {
  const at = stage?.name ? ` at “${STAGE_NAMES[stage.name] ?? stage.name}”` : "";
  const told = { new: "Not made yet", waiting: `Waits for ${before === 1 ? "one other" : `${before} others`}`, making: `Is being made${at}`, stopped: `Stopped${at}`, failed: "Failed", done: "Done" };
  return told[state];
}
