// From what the detector finds to how a person differs from their neutral face: calibration, smoothing, and the mirror.

import { OneEuro, type Smoothing } from "./one_euro";
import { axisAngle, multiplied, rotationMatrix, transposed } from "./rigid";
import { headAtRest, keptShare } from "./transfer";

/** What the detector says about a picture. */
export interface Found {
  /** Names and strengths of blend shapes; null without a face. */
  scores: [string, number][] | null;
  /** From the face to the camera, column by column, in centimetres; +y up, +z towards the viewer. */
  matrix: ArrayLike<number> | null;
  /** Left, top, right and bottom of the nearest face, as parts of the picture; null without a face. */
  box?: number[] | null;
  /** Number of faces that were found, up to the number that was asked for. */
  faces?: number;
  /** When the picture came, on the page's clock. */
  milliseconds: number;
  /** How long the detector worked on it. */
  work: number;
}

/** A face, relative to the person's neutral one. */
export interface Reading {
  /** Coefficients by the names of ARKit in lower case; 0 is neutral, and 1 the most. */
  scores: Map<string, number>;
  /** Turn of the head, row-major; +x to the person's left, +y up, +z ahead. */
  turn: Float64Array;
  /** Motion of the head in metres, in the same axes. */
  shift: [number, number, number];
  /** When the picture came, on the page's clock. */
  milliseconds: number;
  /** How long the detector worked on it, in milliseconds. */
  work: number;
}

/** Length of the calibration in seconds, and the least number of pictures in it. */
const NEUTRAL_SECONDS = 1, NEUTRAL_PICTURES = 5;
/** Largest motion of the head, in metres: it comes near, but does not exceed it. */
const MOST_SHIFT = 0.08;
const CENTIMETRE = 0.01;
/** Score of the detector at which lids are closed: 0.70 to 0.79 on drawn and filmed people. */
const CLOSED = 0.75;
/** They leave 0.35 to 0.5 of the tremble, and add 4 to 40 ms (docs/log.md). Units: 1, radians, metres. */
const SCORES: Smoothing = { rest: 1, follow: 8 }, TURNS: Smoothing = { rest: 0.5, follow: 16 }, SHIFTS: Smoothing = { rest: 0.5, follow: 128 };

/**
 * Limits of scores in the neutral face: up to the first they belong to the person, from the second on they are an expression.
 * The detector's medians over clips of seven people are up to 0.23 for jaws and mouths, but up to 0.8 for brows, eyes and squints.
 */
const MOUTH = [0.3, 0.6], OTHERS = [0.8, 0.95];

interface Raw {
  scores: Map<string, number>;
  turn: number[];
  place: number[];
}

interface Neutral {
  scores: Map<string, number>;
  back: Float64Array;
  place: number[];
}

export class Follower {
  /** Whether left and right are exchanged, as in a mirror. */
  mirrored = true;
  private neutral: Neutral | null = null;
  private gathered: { since: number; rows: Raw[] } | null = { since: NaN, rows: [] };
  /** Whether the person asked for the neutral face, which is then taken as it is. */
  private asked = false;
  private filters = new Map<string, OneEuro>();

  get calibrating(): boolean {
    return this.gathered !== null;
  }

  /** Takes the face of the next second as the neutral one, whatever it shows. */
  calibrate(): void {
    this.asked = true;
    this.gathered = { since: NaN, rows: [] };
  }

  /** What a picture says; null as long as no neutral face is known, or if there is no face. */
  follow(found: Found): Reading | null {
    const { scores, matrix } = found;
    if (!scores || !matrix) return null;
    const size = Math.hypot(matrix[0], matrix[1], matrix[2]) || 1;
    const raw: Raw = {
      scores: new Map(scores.map(([name, score]) => [name.toLowerCase(), score])),
      turn: axisAngle([0, 4, 8, 1, 5, 9, 2, 6, 10].map((k) => matrix[k] / size)),
      place: [12, 13, 14].map((k) => CENTIMETRE * matrix[k]),
    };
    if (this.gathered) this.gather(raw, this.gathered, found.milliseconds / 1000);
    return this.neutral && this.read(raw, this.neutral, found);
  }

  private gather(raw: Raw, gathered: { since: number; rows: Raw[] }, seconds: number): void {
    const { rows } = gathered;
    if (!rows.length) gathered.since = seconds;
    rows.push(raw);
    if (seconds - gathered.since < NEUTRAL_SECONDS || rows.length < NEUTRAL_PICTURES) return;
    this.gathered = null;
    // Medians, so that a blink does not count.
    const middle = (of: (row: Raw) => number) => rows.map(of).sort((a, b) => a - b)[rows.length >> 1];
    const turn = [0, 1, 2].map((k) => middle((row) => row.turn[k]));
    const rest = (name: string, score: number) => (this.asked ? score : atRest(name, score));
    this.neutral = {
      scores: new Map([...raw.scores.keys()].map((name) => [name, rest(name, middle((row) => row.scores.get(name) ?? 0))])),
      back: transposed(rotationMatrix(this.asked ? turn : headAtRest(turn), 0)),
      place: [0, 1, 2].map((k) => middle((row) => row.place[k])),
    };
  }

  private read(raw: Raw, neutral: Neutral, { milliseconds, work }: Found): Reading {
    const side = this.mirrored ? -1 : 1;
    const smooth = (name: string, value: number, smoothing: Smoothing) => {
      let filter = this.filters.get(name);
      if (!filter) this.filters.set(name, (filter = new OneEuro(smoothing)));
      return filter.next(value, milliseconds / 1000);
    };
    const scores = new Map<string, number>();
    for (const [name, score] of raw.scores) {
      const value = smooth(name, beyond(name, score, neutral.scores.get(name) ?? 0), SCORES);
      scores.set(this.mirrored ? otherSide(name) : name, value);
    }
    const turn = axisAngle(multiplied(neutral.back, rotationMatrix(raw.turn, 0))).map((angle, k) => smooth(`turn${k}`, angle, TURNS));
    const { back } = neutral, from = raw.place.map((at, k) => at - neutral.place[k]);
    const [x, y, z] = [0, 3, 6].map((row, k) => {
      const along = back[row] * from[0] + back[row + 1] * from[1] + back[row + 2] * from[2];
      return MOST_SHIFT * Math.tanh(smooth(`shift${k}`, along, SHIFTS) / MOST_SHIFT);
    });
    return { scores, turn: rotationMatrix([turn[0], side * turn[1], side * turn[2]], 0), shift: [side * x, y, z], milliseconds, work };
  }
}

/** The score of a neutral face: as it is in the calibration, unless it is far from 0. */
function atRest(name: string, score: number): number {
  return score * keptShare(score, /^(jaw|mouth)/.test(name) ? MOUTH : OTHERS);
}

/** A score relative to that of the neutral face, so that the strongest expression has 1. */
function beyond(name: string, score: number, neutral: number): number {
  const most = name.startsWith("eyeblink") ? CLOSED : 1;
  return score > neutral ? (score - neutral) / Math.max(most - neutral, 0.2) : score - neutral;
}

/** mouthSmileLeft -> mouthSmileRight, in lower case. */
function otherSide(name: string): string {
  if (name.endsWith("left")) return `${name.slice(0, -4)}right`;
  return name.endsWith("right") ? `${name.slice(0, -5)}left` : name;
}
