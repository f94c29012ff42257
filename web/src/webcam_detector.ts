// What runs in the worker of webcam.ts: MediaPipe's face landmarker, on one picture at a time.
// Its own script, because detection would hold up the drawing of the page for several milliseconds.

import type { Found } from "./follower";
import type { DetectorParts } from "./detector";

interface Landmarker {
  detectForVideo(picture: ImageBitmap, milliseconds: number): {
    faceBlendshapes: { categories: { categoryName: string; score: number }[] }[];
    facialTransformationMatrixes: { data: number[] }[];
    faceLandmarks: { x: number; y: number }[][];
  };
}

/** The worker's global scope. MediaPipe's own scripts look for some of these names in it. */
const scope = self as unknown as {
  exports: { FaceLandmarker: { createFromOptions(files: object, options: object): Promise<Landmarker> } };
  Module: { wasmBinary: ArrayBuffer };
  onmessage: (event: MessageEvent) => void;
  postMessage(told: Found | { ready: true } | { error: string }): void;
  importScripts(address: string): void;
};
let landmarker: Landmarker;

async function open({ vision, loader, wasm, model }: Record<keyof DetectorParts, ArrayBuffer>, numFaces: number): Promise<void> {
  const address = (script: ArrayBuffer) => URL.createObjectURL(new Blob([script], { type: "text/javascript" }));
  // A page from a file has no origin of its own, and then a worker can import no modules, so this is CommonJS.
  scope.exports = {} as typeof scope.exports;
  scope.importScripts(address(vision));
  // With its code at hand, the loader fetches nothing.
  scope.Module = { wasmBinary: wasm };
  landmarker = await scope.exports.FaceLandmarker.createFromOptions(
    { wasmLoaderPath: address(loader), wasmBinaryPath: "" },
    {
      baseOptions: { modelAssetBuffer: new Uint8Array(model), delegate: "CPU" },
      runningMode: "VIDEO", numFaces, outputFaceBlendshapes: true, outputFacialTransformationMatrixes: true,
    },
  );
}

// MediaPipe's messages are for its own developers; what goes wrong is an error, and goes to the page.
for (const way of ["log", "info", "warn", "error"] as const) console[way] = () => {};

scope.onmessage = async ({ data }) => {
  try {
    if (data.parts) {
      await open(data.parts, data.faces);
      return scope.postMessage({ ready: true });
    }
    const picture: ImageBitmap = data.picture, began = performance.now();
    const { faceBlendshapes, facialTransformationMatrixes, faceLandmarks } = landmarker.detectForVideo(picture, data.milliseconds);
    // The nearest face counts, whichever was found first.
    const boxes = faceLandmarks.map(boxOf), size = ([x0, y0, x1, y1]: number[]) => (x1 - x0) * (y1 - y0);
    const near = boxes.reduce((best, box, k) => (size(box) > size(boxes[best]) ? k : best), 0);
    const shapes = faceBlendshapes[near], matrix = facialTransformationMatrixes[near];
    picture.close();
    const scores: [string, number][] | null = shapes ? shapes.categories.map(({ categoryName, score }) => [categoryName, score]) : null;
    const where = { box: boxes[near] ?? null, faces: boxes.length };
    scope.postMessage({ scores, matrix: matrix?.data ?? null, ...where, milliseconds: data.milliseconds, work: performance.now() - began });
  } catch (error) {
    scope.postMessage({ error: `${(error as Error).message ?? error}` });
  }
};

/** Left, top, right and bottom of a face, as parts of the picture. */
function boxOf(points: { x: number; y: number }[]): number[] {
  const [xs, ys] = [points.map(({ x }) => x), points.map(({ y }) => y)];
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}
