// Draws a .spz by PlayCanvas' engine and its own reader, for a test. `draw` returns the picture as a data address.

import { decompress } from "fzstd";
import * as pc from "playcanvas";
import { SpzParser } from "playcanvas/scripts/esm/parsers/spz-parser.mjs";

// The engine wants a ZSTD decoder of the page's own.
pc.WasmModule.setConfig("ZstdDecoderModule", { glueUrl: "none", wasmUrl: "none" });
pc.WasmModule.getInstance = (_, use) => use({ decompress: (bytes, size) => decompress(bytes, new Uint8Array(size)) });

/** `url` from `distance` metres in front, over white, `side` pixels, with a vertical field of view in degrees. */
export async function draw(canvas, url, side, distance, fov) {
  const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false, alpha: false, preserveDrawingBuffer: true } });
  app.setCanvasFillMode(pc.FILLMODE_NONE, side, side);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, side, side);
  app.loader.getHandler("gsplat").addParser(new SpzParser(app));
  const asset = new pc.Asset("avatar", "gsplat", { url });
  app.assets.add(asset);
  await new Promise((done, failed) => {
    asset.once("load", done);
    asset.once("error", (error) => failed(new Error(`${error}`)));
    app.assets.load(asset);
  });
  const splats = new pc.Entity("splats"), camera = new pc.Entity("camera");
  splats.addComponent("gsplat", { asset });
  camera.addComponent("camera", { clearColor: new pc.Color(1, 1, 1, 1), fov, nearClip: 0.1, farClip: 100 });
  camera.setPosition(0, 0, distance);
  app.root.addChild(splats);
  app.root.addChild(camera);
  app.start();
  // Splats are sorted in a worker, some pictures later.
  let left = 60;
  await new Promise((done) => app.on("frameend", () => --left || done()));
  return canvas.toDataURL();
}
