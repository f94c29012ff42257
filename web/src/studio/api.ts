// Talks to the studio's server. Everything has the page's own origin, and a cookie that the page cannot read.

export interface Stage {
  name: string;
  number: number;
  of: number;
  percent: number | null;
}

export interface Progress {
  state: "new" | "waiting" | "making" | "stopped" | "failed" | "done";
  stage: Stage | null;
  seconds_left: number | null;
  error: string;
  before: number;
}

export interface Short {
  name: string;
  /** When the picture changed; null without one. */
  face: number | null;
  changed: number;
  progress: Progress;
  made: boolean;
}

export interface Film {
  name: string;
  size: number;
  whole: boolean;
  /** Whether another page, or a phone, is sending it. */
  coming: boolean;
  facts: { width?: number; height?: number; seconds?: number };
}

export interface Settings {
  quality: string;
  method: string;
  shoulders: boolean;
  threads: number;
  keep_film: boolean;
}

export interface Whole extends Short {
  films: Film[];
  takings: { kind: string; title: string; opens: string; ready: boolean }[];
  settings: Settings;
  growing: number | null;
  fit: number | null;
  advice: string[];
  /** `size` is that of the whole film; -1 if the phone has not told it. */
  phone: { film: string | null; size: number; done: boolean } | null;
}

export interface Listed {
  folder: string;
  people: Short[];
  offered: { qualities: string[]; methods: string[]; threads: number; lan: boolean };
}

/** What the server refuses, in its words. `status` is 0 if it does not answer. */
export class Refused extends Error {
  constructor(message: string, readonly status: number) {
    super(message);
  }
}

/** Largest piece of a film in one request. */
const PIECE = 4 << 20;

/** Asks the server. An object is sent as json, anything else as it is. */
export async function ask<T>(method: string, path: string, body?: object | Blob): Promise<T> {
  const raw = body instanceof Blob, json = body && !raw;
  let answer: Response;
  try {
    answer = await fetch(path, { method, body: json ? JSON.stringify(body) : (body as Blob), headers: json ? { "Content-Type": "application/json" } : {} });
  } catch {
    throw new Refused("The studio does not answer. If it has ended, start it again and open its new address.", 0);
  }
  const told = await answer.json().catch(() => ({ error: `The studio answers ${answer.status}. Open the address that mien printed.` }));
  if (!answer.ok) throw new Refused(sentence(told.error ?? `The studio answers ${answer.status}.`), answer.status);
  return told;
}

/** A message of mien as a sentence. */
export const sentence = (text: string) => text.charAt(0).toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".");

export const person = (name: string, ...more: string[]) => ["/api/people", name, ...more].map((part, k) => (k ? encodeURIComponent(part) : part)).join("/");

/** Sends a film piece by piece, so that what has arrived stays if the page is closed. */
export class Sending {
  sent = 0;
  private last: Promise<void> = Promise.resolve();

  private constructor(private readonly address: (at: number) => string) {}

  static async begin(name: string, ending: string): Promise<[Sending, string]> {
    const { film } = await ask<{ film: string }>("POST", person(name, "films"), { ending });
    return [new Sending((at) => `${person(name, "films", film)}?at=${at}`), film];
  }

  /** Sends what follows the bytes that are there. */
  static at(address: (at: number) => string, sent = 0): Sending {
    const sending = new Sending(address);
    sending.sent = sent;
    return sending;
  }

  /** Sends what follows what was sent before. */
  send(part: Blob, moved: (sent: number) => void = () => {}): Promise<void> {
    return (this.last = this.last.then(async () => {
      for (let from = 0; from < part.size; from += PIECE) {
        const piece = part.slice(from, from + PIECE);
        this.sent = (await ask<{ size: number }>("PUT", this.address(this.sent), piece)).size;
        moved(this.sent);
      }
    }));
  }
}

/** The ending of a film's name, in lower case. */
export const endingOf = (name: string) => (name.includes(".") ? name.split(".").pop()!.toLowerCase() : "");
