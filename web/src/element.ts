// <mien-avatar src="me.packed" expression="jawOpen:0.5 eyeBlinkLeft:1" controls idle></mien-avatar>

import { enliven } from "./alive";
import type { Motion } from "./avatar";
import { addTurning, fit } from "./controls";
import { AvatarError, readAll, readAny } from "./format";
import { Viewer } from "./viewer";
import type { BackendName } from "./webgpu";

const RADIANS = Math.PI / 180;
const STYLE = ":host{display:inline-block;width:320px;height:320px}canvas{display:block;width:100%;height:100%;outline-offset:-2px}p{margin:0;padding:1em;font:14px/1.4 system-ui,sans-serif;overflow-wrap:anywhere}:host([controls]) canvas{touch-action:none;cursor:grab}";

/**
 * An avatar as an element. Attributes:
 * `src`: address of a .packed or .mien file.
 * `expression`: names and strengths, `smile:0.4 jawOpen:0.5 eyeLookUpLeft:1`; all others are those of the person at rest.
 * `yaw`, `pitch`, `zoom`: the camera, in degrees to the person's left and upwards.
 * `backend`: `auto` or `webgpu` loads webgpu.js, which lies beside this file; without it, WebGL2 draws.
 * `controls`: may be turned by hand. `idle`: blinks and moves a little.
 *
 * Events: `load` when it can be seen, `error` (a CustomEvent whose detail is the message) when it cannot. The message is
 * also in its box, as `::part(error)` for CSS.
 */
export class MienAvatar extends HTMLElement {
  static readonly observedAttributes = ["src", "expression", "yaw", "pitch", "zoom", "idle"];
  /** What draws the avatar, or null before `load`. */
  viewer: Viewer | null = null;
  private readonly observer = new ResizeObserver(() => this.viewer && fit(this.viewer));
  private loading: AbortController | null = null;
  private beating = 0;
  private attached = false;

  connectedCallback(): void {
    this.attached = true;
    this.open();
  }

  disconnectedCallback(): void {
    this.attached = false;
    this.close();
  }

  attributeChangedCallback(name: string, before: string | null, now: string | null): void {
    // Before it is attached, as when the page had it before this script, one fetch is enough.
    if (!this.attached || before === now) return;
    if (name === "src") this.open();
    else if (name === "idle") this.live();
    else if (name === "expression") this.pose();
    else this.look();
  }

  get src(): string {
    return this.getAttribute("src") ?? "";
  }

  set src(address: string) {
    this.setAttribute("src", address);
  }

  get expression(): string {
    return this.getAttribute("expression") ?? "";
  }

  set expression(text: string) {
    this.setAttribute("expression", text);
  }

  /** Sets an expression, a gaze or a whole face, and leaves the others. False if the name does nothing, or the avatar is not there yet. */
  setExpression(name: string, value: number): boolean {
    return this.viewer?.setExpression(name, value) ?? false;
  }

  /** Plays the motion that came with the file, or another one. */
  play(motion?: Motion): void {
    if (motion) this.viewer?.setMotion(motion);
    this.viewer?.play();
  }

  pause(): void {
    this.viewer?.play(false);
  }

  private close(): void {
    this.loading?.abort();
    this.observer.disconnect();
    this.viewer?.dispose();
    this.viewer = this.loading = null;
  }

  private show(content: HTMLElement): void {
    const style = document.createElement("style");
    style.textContent = STYLE;
    (this.shadowRoot ?? this.attachShadow({ mode: "open" })).replaceChildren(style, content);
  }

  /** Shows a message where the avatar would be. */
  private tell(words: string): void {
    this.viewer?.dispose();
    this.viewer = null;
    const text = document.createElement("p");
    text.textContent = words;
    text.setAttribute("part", "error");
    text.setAttribute("role", "alert");
    this.show(text);
  }

  private async open(): Promise<void> {
    this.close();
    if (!this.src) return;
    const loading = (this.loading = new AbortController());
    try {
      const answer = await fetch(this.src, { signal: loading.signal });
      if (!answer.ok) throw new AvatarError(`cannot be fetched: the server answers ${answer.status}`);
      const { avatar, motion } = await readAny(new Uint8Array(await readAll(answer.body!)));
      const named = this.getAttribute("backend") as BackendName | null;
      const backend = named && named !== "webgl2" ? await webgpu(named) : undefined;
      if (loading.signal.aborted) return;
      const canvas = document.createElement("canvas");
      this.show(canvas);
      // Not before there is a label. To screen readers, what is inside of a picture is hidden, an error as well.
      if (!this.hasAttribute("role")) this.setAttribute("role", "img");
      if (!this.hasAttribute("aria-label")) this.setAttribute("aria-label", `Avatar of ${avatar.about.name}`);
      const viewer = (this.viewer = new Viewer(canvas, avatar, motion, backend));
      if (this.hasAttribute("controls")) {
        canvas.tabIndex = 0;
        addTurning(viewer);
      }
      this.pose();
      this.look();
      this.observer.observe(canvas);
      fit(viewer);
      this.live();
      this.dispatchEvent(new Event("load"));
    } catch (error) {
      if (loading.signal.aborted) return;
      const { message } = error as Error;
      const detail = error instanceof AvatarError ? `${this.src} ${message}` : `${this.src} cannot be shown: ${message}`;
      this.tell(detail);
      this.dispatchEvent(new CustomEvent("error", { detail }));
    }
  }

  private pose(): void {
    const { viewer } = this;
    if (!viewer) return;
    viewer.take(viewer.avatar.neutral);
    for (const one of this.expression.split(/[\s,]+/).filter(Boolean)) {
      const [name, value] = one.split(":");
      if (!viewer.setExpression(name, Number(value) || 0)) console.warn(`<mien-avatar>: ${name} does nothing`);
    }
    viewer.change();
  }

  private look(): void {
    const { viewer } = this, number = (name: string, otherwise: number) => Number(this.getAttribute(name) ?? otherwise) || otherwise;
    if (!viewer) return;
    [viewer.yaw, viewer.pitch, viewer.zoom] = [number("yaw", 0) * RADIANS, number("pitch", 0) * RADIANS, number("zoom", 1)];
    viewer.look();
  }

  private live(): void {
    const { viewer } = this, idle = this.hasAttribute("idle");
    if (!viewer) return;
    viewer.alive = idle ? (face) => enliven(face, viewer.avatar, { idle, pointer: null }, performance.now() / 1000) : null;
    viewer.change();
    const beat = () => {
      this.beating = this.viewer?.alive ? requestAnimationFrame(beat) : 0;
      if (!this.viewer?.playing) this.viewer?.change();
    };
    if (idle && !this.beating) this.beating = requestAnimationFrame(beat);
  }
}

/** The back end of webgpu.js, which a page need not have. */
const webgpu = (named: BackendName) =>
  import("./webgpu.js").then(({ findBackend }) => findBackend(named), (error) => void console.warn(`<mien-avatar>: ${error.message}; WebGL2 draws instead`));

if (!customElements.get("mien-avatar")) customElements.define("mien-avatar", MienAvatar);

/** The events of the element beside those of all elements. */
export interface MienAvatarEvents {
  load: Event;
  error: CustomEvent<string>;
}

type Listener<K extends keyof MienAvatarEvents> = (this: MienAvatar, event: MienAvatarEvents[K]) => void;

// Its events have types of their own: `event.detail` of "error" is the message.
export interface MienAvatar {
  addEventListener<K extends keyof MienAvatarEvents>(type: K, listener: Listener<K>, options?: boolean | AddEventListenerOptions): void;
  addEventListener(type: string, listener: EventListenerOrEventListenerObject, options?: boolean | AddEventListenerOptions): void;
  removeEventListener<K extends keyof MienAvatarEvents>(type: K, listener: Listener<K>, options?: boolean | EventListenerOptions): void;
  removeEventListener(type: string, listener: EventListenerOrEventListenerObject, options?: boolean | EventListenerOptions): void;
}

declare global {
  interface HTMLElementTagNameMap {
    "mien-avatar": MienAvatar;
  }
}
