// The One Euro filter (Casiez, Roussel, Vogel: 1 Euro Filter, CHI 2012): slow motion is smoothed, and fast motion is followed.

export interface Smoothing {
  /** Cutoff of a value at rest, in Hz: lower trembles less. */
  rest: number;
  /** Growth of the cutoff with the speed of the value, in Hz per unit a second: higher follows faster. */
  follow: number;
}

/** Cutoff of the speed itself, in Hz. */
const SPEED_CUTOFF = 3;

export class OneEuro {
  private value = 0;
  private speed = 0;
  private before = NaN;

  constructor(private readonly smoothing: Smoothing) {}

  /** The smoothed value. `seconds` must increase; a time that does not changes nothing. */
  next(value: number, seconds: number): number {
    const step = seconds - this.before;
    if (!(step <= 0)) this.before = seconds;
    if (Number.isNaN(step)) return (this.value = value);
    if (step <= 0) return this.value;
    const share = (cutoff: number) => 1 / (1 + 1 / (2 * Math.PI * cutoff * step));
    this.speed += share(SPEED_CUTOFF) * ((value - this.value) / step - this.speed);
    this.value += share(this.smoothing.rest + this.smoothing.follow * Math.abs(this.speed)) * (value - this.value);
    return this.value;
  }
}
