// A second file of the package: recordings of other programs, and signs of life.
export { blinkAt, enliven, swayAt } from "./alive";
export type { Life } from "./alive";
export { readSeries } from "./series";
