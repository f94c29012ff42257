// Small helpers of the studio's pages.

export const find = <T extends HTMLElement = HTMLElement>(id: string) => document.getElementById(id) as T;
export const button = (id: string) => find<HTMLButtonElement>(id);
export const on = (id: string, what: string, act: (event: Event) => unknown) => find(id).addEventListener(what, (event) => void attempt(() => act(event)));

/** An element with properties and children. */
export function make<K extends keyof HTMLElementTagNameMap>(tag: K, properties: Partial<HTMLElementTagNameMap[K]> = {}, ...children: (Node | string)[]): HTMLElementTagNameMap[K] {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

/** A button that acts. While it does, it cannot be pressed again. */
export function press(text: string, act: () => unknown, label = text): HTMLButtonElement {
  const made = make("button", { type: "button" }, text);
  if (label !== text) made.setAttribute("aria-label", label);
  made.addEventListener("click", () => void busy(made, act));
  return made;
}

export async function busy(which: HTMLButtonElement, act: () => unknown): Promise<void> {
  which.disabled = true;
  await attempt(act);
  which.disabled = false;
  // A button that cannot be pressed loses the focus.
  if (document.activeElement === document.body) which.focus();
}

let clearing = 0;
/** Shows a message, which goes away by itself. */
export function say(text: string, seconds = 9): void {
  find("message").textContent = text;
  clearTimeout(clearing);
  clearing = window.setTimeout(() => (find("message").textContent = ""), 1000 * seconds);
}

/** Does something, and says what went wrong. */
export async function attempt(act: () => unknown): Promise<void> {
  try {
    await act();
  } catch (error) {
    say((error as Error).message ?? `${error}`);
  }
}

/** Replaces what is in an element, unless it is the same. So what is pressed or read does not vanish at each look. */
export function fill(id: string, key: unknown, parts: () => (Node | string)[]): void {
  const text = JSON.stringify(key), place = find(id);
  if (place.dataset.key === text) return;
  const kept = [...place.querySelectorAll("button")].indexOf(document.activeElement as HTMLButtonElement);
  place.dataset.key = text;
  place.replaceChildren(...parts());
  if (kept >= 0) place.querySelectorAll("button")[kept]?.focus();
}

/** A duration, as people say it. */
export function duration(seconds: number): string {
  if (seconds < 50) return `${Math.max(5, 5 * Math.round(seconds / 5))} seconds`;
  const minutes = Math.round(seconds / 60);
  if (minutes < 90) return minutes <= 1 ? "a minute" : `${minutes} minutes`;
  return `${Math.round(seconds / 3600)} hours`;
}

/** Asks a question that “Delete” answers with yes. */
export function sure(title: string, text: string): Promise<boolean> {
  const dialog = find<HTMLDialogElement>("sure");
  find("sure-title").textContent = title;
  find("sure-words").textContent = text;
  dialog.returnValue = "no";
  dialog.showModal();
  return new Promise((done) => dialog.addEventListener("close", () => done(dialog.returnValue === "yes"), { once: true }));
}
