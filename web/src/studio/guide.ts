// Guides a person through a film: what is wrong, which sides and faces are still missing, and when there is enough.
// It knows no camera and no clock, so films are checked by the same rules as the camera's picture.

import { Follower, type Found } from "../follower";
import type { Light } from "./light";

export interface Fault {
  /** What is wrong, in about three words. */
  words: string;
  remedy: string;
}

/** The directions in which the head turns, counterclockwise in the mirror from its right side. */
export const DIRECTIONS = 8;
/** Turns to the side, and up or down, at which a direction is full, in radians. Trained avatars fade beyond what was filmed. */
const SIDE = 0.5, UP_OR_DOWN = 0.2;
/** Length of a film in seconds: with all that is needed, and at the most. */
export const LEAST = 30, MOST = 45;
/** Seconds for which a fault must last before it is said, and before it goes away. */
const LASTS = 0.4;
/** Seconds of one request, before another one takes its turn. */
const PATIENCE = 6;
/** Seconds for which the eyes stay shut. */
const SHUT = 0.4;

export interface Motion {
  name: string;
  ask: string;
  /** How strong it is, 1 is enough. */
  strength: (score: (name: string) => number) => number;
}

export const MOTIONS: Motion[] = [
  { name: "smile", ask: "Smile, and show your teeth", strength: (of) => (of("mouthsmileleft") + of("mouthsmileright")) / 0.9 },
  { name: "brows", ask: "Raise your eyebrows", strength: (of) => Math.max(of("browinnerup"), of("browouterupleft"), of("browouterupright")) / 0.4 },
  { name: "A", ask: "Say a long A", strength: (of) => of("jawopen") / 0.4 },
  { name: "O", ask: "Say O and U", strength: (of) => Math.max(of("mouthpucker"), of("mouthfunnel")) / 0.35 },
  { name: "eyes", ask: "Shut your eyes for a second", strength: (of) => Math.min(of("eyeblinkleft"), of("eyeblinkright")) / 0.6 },
];

const FAULTS: Record<string, Fault> = {
  none: { words: "No face seen", remedy: "Look into the camera, with your face inside the outline." },
  two: { words: "Two people here", remedy: "Only one of you can be in the picture." },
  lamp: { words: "Lamp behind you", remedy: "Turn off the lamp behind you, or turn around." },
  dark: { words: "Too dark here", remedy: "Turn on a lamp in front of you, or sit before a window." },
  far: { words: "Too far away", remedy: "Come closer, until your face fills the outline." },
  near: { words: "Too close now", remedy: "Move back, until your face fits into the outline." },
  aside: { words: "Off the center", remedy: "Move until your face is inside the outline." },
  blurred: { words: "The picture blurs", remedy: "Move slowly, and clean the lens if it stays." },
};

export class Guide {
  /** How far the head has turned in each direction, 1 is enough. */
  readonly turned = new Float64Array(DIRECTIONS);
  /** How far each face was made, 1 is enough. */
  readonly moved = new Float64Array(MOTIONS.length);
  fault: Fault | null = null;
  /** What the person shall do now. */
  request = "Look straight ahead, relaxed";
  /** Seconds since the first picture. */
  seconds = 0;
  /** Where the head turns now: to the left and up in the mirror, 1 is enough; null without a face. */
  pointer: [number, number] | null = null;

  private readonly follower = new Follower();
  private began = NaN;
  private candidate = { name: "", since: 0 };
  private readonly sharpest: number[] = [];
  private asked = { what: -2, since: 0 };
  private shutSince = NaN;
  private readonly faulty = new Map<string, number>();
  private pictures = 0;

  constructor() {
    this.follower.mirrored = false;
  }

  /** Whether every side and every face was seen. */
  get full(): boolean {
    return this.turned.every((share) => share >= 1) && this.moved.every((share) => share >= 1);
  }

  /** Whether the film can end: it has everything, or is as long as it may be. */
  get done(): boolean {
    return this.seconds >= (this.full ? LEAST : MOST);
  }

  see(found: Found, light: Light | null): void {
    const now = found.milliseconds / 1000;
    if (Number.isNaN(this.began)) this.began = this.candidate.since = this.asked.since = now;
    this.seconds = now - this.began;
    this.pictures++;
    this.judge(this.faultOf(found, light), now);
    const reading = this.follower.follow(found);
    this.pointer = null;
    if (reading) {
      const [, , x, , , y, , , z] = reading.turn;
      this.turn(Math.atan2(x, z) / SIDE, Math.asin(Math.max(-1, Math.min(1, y))) / UP_OR_DOWN);
      this.move((name) => reading.scores.get(name) ?? 0, now);
    }
    this.choose(now, reading !== null);
  }

  /** What would make the film better, the gravest first. */
  missing(): string[] {
    const told: string[] = [];
    const faults = [...this.faulty].filter(([, count]) => count > 0.15 * this.pictures).sort(([, a], [, b]) => b - a);
    for (const [name] of faults) told.push(`${FAULTS[name].words}: ${FAULTS[name].remedy}`);
    const sides = [["right", 0], ["up", 2], ["left", 4], ["down", 6]] as const;
    const short = sides.filter(([, k]) => this.turned[k] < 1).map(([name]) => name);
    if (short.length) told.push(`Turn your head further: ${short.join(", ")}.`);
    MOTIONS.forEach(({ ask }, k) => this.moved[k] < 1 && told.push(`${ask}.`));
    if (this.seconds < LEAST / 2) told.push(`Film for ${LEAST} seconds; this is ${Math.round(this.seconds)}.`);
    return told;
  }

  private turn(left: number, up: number): void {
    this.pointer = [left, up];
    const angle = Math.atan2(up, -left), reach = Math.hypot(left, up), step = (2 * Math.PI) / DIRECTIONS;
    const direction = (Math.round(angle / step) + DIRECTIONS) % DIRECTIONS;
    this.turned[direction] = Math.max(this.turned[direction], Math.min(reach, 1));
  }

  private move(score: (name: string) => number, now: number): void {
    MOTIONS.forEach(({ name, strength }, k) => {
      let share = Math.min(strength(score), 1);
      if (name === "eyes") {
        if (share < 1) this.shutSince = NaN;
        else if (Number.isNaN(this.shutSince)) this.shutSince = now;
        // A blink is not enough.
        share = share < 1 ? share / 2 : Math.min(1, 0.5 + (now - this.shutSince) / SHUT / 2);
      }
      this.moved[k] = Math.max(this.moved[k], share);
    });
  }

  private faultOf({ scores, box, faces }: Found, light: Light | null): string {
    if (!scores || !box) return "none";
    if ((faces ?? 1) > 1) return "two";
    if (light) {
      if (light.around > 0.5 && light.face < 0.5 * light.around) return "lamp";
      if (light.face < 0.18) return "dark";
    }
    const [left, top, right, bottom] = box, height = bottom - top;
    if (height < 0.24) return "far";
    if (height > 0.85) return "near";
    if (Math.abs((left + right) / 2 - 0.5) > 0.2 || Math.abs((top + bottom) / 2 - 0.5) > 0.25) return "aside";
    if (light) {
      this.sharpest.push(light.sharpness);
      if (this.sharpest.length > 100) this.sharpest.shift();
      const best = [...this.sharpest].sort((a, b) => a - b)[Math.floor(0.8 * this.sharpest.length)];
      if (light.sharpness < 0.45 * best) return "blurred";
    }
    return "";
  }

  private judge(name: string, now: number): void {
    if (name) this.faulty.set(name, (this.faulty.get(name) ?? 0) + 1);
    if (name !== this.candidate.name) this.candidate = { name, since: now };
    if (now - this.candidate.since >= LASTS) this.fault = name ? FAULTS[name] : null;
  }

  /** Chooses what the person shall do: turn first, then each face that is missing, in turns. */
  private choose(now: number, known: boolean): void {
    const wants = [this.turned.some((share) => share < 1), ...Array.from(this.moved, (share) => share < 1)];
    const { what, since } = this.asked;
    if (!known) return;
    if (what >= -1 && wants[what + 1] && now - since < (what < 0 ? 2 * PATIENCE : PATIENCE)) return;
    const count = wants.length, from = what < -1 ? 0 : what + 2;
    const next = Array.from({ length: count }, (_, k) => (from + k) % count).find((k) => wants[k]);
    this.asked = { what: next === undefined ? -2 : next - 1, since: now };
    if (next === undefined) this.request = "Well done. Now say a few sentences";
    else this.request = next ? MOTIONS[next - 1].ask : "Turn your head slowly, all around the ring";
  }
}
