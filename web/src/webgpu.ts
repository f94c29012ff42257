// The back end that draws with WebGPU. It is a file of its own, which a page loads only if it wants it.

import type { Avatar } from "./avatar";
import { GpuRenderer, Pipelines } from "./gpu_renderer";
import type { Backend, Color, Drawer, Renderer, View } from "./renderer";
import type { Poser } from "./rig";

/**
 * What draws: "webgl2"; "webgpu", on any adapter, also in software; or "auto", which is WebGPU where the browser has an
 * adapter in hardware. Where WebGPU is missing, the console says why, and WebGL2 draws.
 */
export type BackendName = "auto" | "webgl2" | "webgpu";

/** Finds a back end for viewers: the last argument of `Viewer`. Undefined is WebGL2. */
export async function findBackend(name: BackendName = "auto"): Promise<Backend | undefined> {
  if (name === "webgl2") return undefined;
  try {
    const device = await deviceFor(name), lost = device.lost;
    device.pushErrorScope("validation");
    const pipelines = new Pipelines(device, navigator.gpu.getPreferredCanvasFormat());
    const error = await device.popErrorScope();
    if (error) throw new Error(error.message);
    return (...given) => new LastingRenderer(pipelines, lost, ...given);
  } catch (error) {
    tell((error as Error).message);
    return undefined;
  }
}

const tell = (reason: string) => console.warn(`mien: ${reason}; WebGL2 draws instead`);

async function deviceFor(name: BackendName): Promise<GPUDevice> {
  if (!navigator.gpu) throw new Error("this browser has no WebGPU, or the page has no secure address");
  const adapter = await navigator.gpu.requestAdapter({ powerPreference: "high-performance" });
  if (!adapter) throw new Error("WebGPU has no adapter here");
  if (name === "auto" && adapter.info.isFallbackAdapter) throw new Error("WebGPU has an adapter in software only");
  const { maxStorageBufferBindingSize, maxBufferSize } = adapter.limits;
  return adapter.requestDevice({ requiredLimits: { maxStorageBufferBindingSize, maxBufferSize } });
}

/**
 * Draws with WebGPU, and with WebGL2 once the device is lost. A canvas keeps its first kind of context, so the viewer's
 * canvas takes over pictures of one that is not seen.
 */
class LastingRenderer implements Drawer {
  private hidden = new OffscreenCanvas(1, 1);
  private readonly screen: CanvasRenderingContext2D;
  private drawer: Drawer;
  private disposed = false;

  constructor(
    pipelines: Pipelines, lost: Promise<GPUDeviceLostInfo>, canvas: HTMLCanvasElement,
    avatar: Avatar, poser: Poser, change: () => void, WebGl2: typeof Renderer,
  ) {
    this.screen = canvas.getContext("2d")!;
    const fallBack = (reason: string) => {
      tell(reason);
      poser.binds = true;
      // What the poser holds is of no face: it has computed little of the last one.
      poser.activations.fill(NaN);
      const hidden = (this.hidden = new OffscreenCanvas(1, 1));
      hidden.addEventListener("webglcontextlost", (event) => event.preventDefault());
      hidden.addEventListener("webglcontextrestored", () => {
        this.drawer = new WebGl2(hidden, avatar, poser);
        change();
      });
      return new WebGl2(hidden, avatar, poser);
    };
    poser.binds = false;
    try {
      this.drawer = new GpuRenderer(pipelines, this.hidden.getContext("webgpu") as unknown as GPUCanvasContext, avatar, poser);
    } catch (error) {
      this.drawer = fallBack(`this avatar ${(error as Error).message}`);
      return;
    }
    lost.then(({ message }) => {
      if (this.disposed) return;
      this.drawer = fallBack(`the WebGPU device is lost (${message.trim() || "no reason is given"})`);
      change();
    }).catch((error: Error) => console.error(`mien: ${error.message}`));
  }

  upload(): void {
    this.drawer.upload();
  }

  draw(order: () => Uint32Array, view: View, background: Color): void {
    const { hidden, screen } = this, { width, height } = view;
    if (hidden.width !== width || hidden.height !== height) [hidden.width, hidden.height] = [width, height];
    this.drawer.draw(order, view, background);
    screen.globalCompositeOperation = "copy";
    screen.drawImage(hidden, 0, 0);
  }

  dispose(): void {
    this.disposed = true;
    this.drawer.dispose();
  }
}
