// Measures the light and the sharpness of a picture: of its face, and around it.

export interface Light {
  /** Mean levels, 0 to 1 as in sRGB. */
  face: number;
  around: number;
  /** How strong fine detail of the face is, relative to its contrast. */
  sharpness: number;
}

const SIDE = 96, SMALL = 32;

const canvas = (side: number) => new OffscreenCanvas(side, side).getContext("2d", { willReadFrequently: true })!;
let face: OffscreenCanvasRenderingContext2D | undefined, whole: OffscreenCanvasRenderingContext2D | undefined;

function levels(brush: OffscreenCanvasRenderingContext2D, side: number): Float32Array {
  const { data } = brush.getImageData(0, 0, side, side), grey = new Float32Array(side * side);
  for (let k = 0; k < grey.length; ++k) grey[k] = (0.3 * data[4 * k] + 0.59 * data[4 * k + 1] + 0.11 * data[4 * k + 2]) / 255;
  return grey;
}

const mean = (values: Float32Array) => values.reduce((sum, value) => sum + value, 0) / values.length;

/** `box` is that of the face, as parts of the picture. */
export function lightOf(picture: HTMLVideoElement, box: number[]): Light {
  const { videoWidth: w, videoHeight: h } = picture, [x0, y0, x1, y1] = box;
  face ??= canvas(SIDE);
  whole ??= canvas(SMALL);
  face.drawImage(picture, x0 * w, y0 * h, (x1 - x0) * w, (y1 - y0) * h, 0, 0, SIDE, SIDE);
  whole.drawImage(picture, 0, 0, SMALL, SMALL);
  const near = levels(face, SIDE), far = levels(whole, SMALL);
  const outside = far.filter((_, k) => {
    const [x, y] = [((k % SMALL) + 0.5) / SMALL, (Math.floor(k / SMALL) + 0.5) / SMALL];
    return x < x0 || x > x1 || y < y0 || y > y1;
  });
  const level = mean(near);
  let detail = 0, contrast = 1e-6;
  for (let y = 1; y < SIDE - 1; ++y)
    for (let x = 1; x < SIDE - 1; ++x) {
      const k = y * SIDE + x;
      detail += Math.abs(4 * near[k] - near[k - 1] - near[k + 1] - near[k - SIDE] - near[k + SIDE]);
      contrast += Math.abs(near[k] - level);
    }
  return { face: level, around: outside.length ? mean(outside) : level, sharpness: detail / contrast };
}
