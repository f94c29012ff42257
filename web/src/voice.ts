// A voice moves the mouth as it sounds: what src/mien/driving/sources/speech.py does with a file, without knowing what comes next.

/** Coefficients by ARKit's names. */
export type Mouth = Record<string, number>;

/** Seconds of sound that say what is loud and what is noise. */
const REMEMBERED = 12;
/** Percentiles of the noise floor and of a loud voice, in 1. */
const FLOOR = 0.1, LOUD = 0.95;
/** Distance from the noise floor to a loud voice in dB, and the least loudness of one, where 0 is the loudest possible. */
const RANGE = [25, 45], SILENCE = -55;
/** Share of this distance that is silence, and the exponent from the level to opening. */
const GATE = 0.15, EXPONENT = 2;
/** Drops of the level in dB, within so many seconds, from which on lips begin to shut, and at which they are shut. */
const DROP = [14, 26], WITHIN = 0.14;
/** Time in which the mouth goes two thirds of its way, in seconds. */
const SOFT = 0.02;
/** Frequencies in Hz below which sound is low, and above which it is high. */
const SPLIT = [700, 2500];
/** Bands in Hz in which open vowels are louder than closed ones, how much each counts, and the smallest share of the energy that counts. */
const BANDS = [[500, 900, 1], [1400, 3000, 0.5]], LEAST = 10 ** -2.5;

const clip = (value: number, least = 0, most = 1) => Math.min(Math.max(value, least), most);

export class Voice {
  private heard: [seconds: number, loudness: number, level: number][] = [];
  private opening = 0;
  private low = 0;
  private high = 0;

  /**
   * The mouth for a moment of sound.
   * @param loudness In dB; 0 is the loudest possible.
   * @param vowel What the bands of open vowels add to it, in dB.
   * @param low Share of the energy at low frequencies, and `high` at high ones.
   * @param seconds When it sounded; increases.
   */
  next(loudness: number, vowel: number, low: number, high: number, seconds: number): Mouth {
    const { heard } = this, step = seconds - (heard.at(-1)?.[0] ?? seconds), level = loudness + vowel;
    heard.push([seconds, loudness, level]);
    while (heard[0][0] < seconds - REMEMBERED) heard.shift();
    const opening = this.above(level, 2) ** EXPONENT * Math.sign(this.above(loudness, 1, SILENCE + RANGE[0]));
    const before = Math.max(...heard.filter(([when]) => when > seconds - WITHIN).map((moment) => moment[2]));
    const shut = clip((before - level - DROP[0]) / (DROP[1] - DROP[0])) * (1 - clip(6 * high));
    const share = 1 - Math.exp(-step / SOFT), soft = (from: number, to: number) => from + share * (to - from);
    this.opening = soft(this.opening, opening);
    this.low = soft(this.low, clip(2 * low - 1));
    this.high = soft(this.high, clip(high));
    const open = this.opening * (1 - shut), lower = 0.25 * open, upper = 0.12 * open, wide = 0.3 * open * this.high, press = 0.3 * shut * clip(10 * this.above(before, 2));
    return {
      jawOpen: 0.55 * open * (1 - 0.6 * this.high),
      mouthLowerDownLeft: lower, mouthLowerDownRight: lower, mouthUpperUpLeft: upper, mouthUpperUpRight: upper,
      mouthFunnel: 0.35 * open * this.low, mouthStretchLeft: wide, mouthStretchRight: wide, mouthPressLeft: press, mouthPressRight: press,
    };
  }

  /**
   * How far a loudness (column 1 of what was heard) or a level (2) is above the noise floor, 0..1, where 1 is that of a loud voice.
   * A steady noise is no voice: one is louder than its pauses.
   */
  private above(decibels: number, column: 1 | 2, least = -Infinity): number {
    const sorted = this.heard.map((moment) => moment[column]).sort((a, b) => a - b), at = (share: number) => sorted[Math.floor(share * (sorted.length - 1))];
    const loud = Math.max(at(LOUD), at(FLOOR) + RANGE[0], least), floor = Math.max(at(FLOOR), loud - RANGE[1]);
    return clip(((decibels - floor) / (loud - floor) - GATE) / (1 - GATE));
  }
}

/** Loudness in dB of what an analyser hears now, what the bands of open vowels add to it, and the shares of its energy at low and at high frequencies. */
export function measured(analyser: AnalyserNode): [loudness: number, vowel: number, low: number, high: number] {
  const samples = new Float32Array(analyser.fftSize), spectrum = new Float32Array(analyser.frequencyBinCount);
  analyser.getFloatTimeDomainData(samples);
  analyser.getFloatFrequencyData(spectrum);
  const mean = samples.reduce((sum, x) => sum + x, 0) / samples.length, power = samples.reduce((sum, x) => sum + (x - mean) ** 2, 0) / samples.length;
  const wide = analyser.context.sampleRate / analyser.fftSize;
  const energy = spectrum.map((level, k) => k && 10 ** (level / 10)), all = Math.max(energy.reduce((sum, x) => sum + x, 0), 1e-20);
  const share = (from: number, to: number) => energy.reduce((sum, x, k) => sum + (k * wide >= from && k * wide < to ? x : 0), 0) / all;
  const vowel = BANDS.reduce((sum, [from, to, weight]) => sum + 10 * weight * Math.log10(Math.max(share(from, to), LEAST)), 0);
  return [10 * Math.log10(Math.max(power, 1e-12)), vowel, share(0, SPLIT[0]), share(SPLIT[1], Infinity)];
}
