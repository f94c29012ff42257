// Avatars in a scene of PlayCanvas (engine 2.23) as its own splats, which it sorts with all others.

import { BoundingBox, Entity, GSplatContainer, GSplatFormat, PIXELFORMAT_RGBA32F, SHADERLANGUAGE_GLSL, ShaderChunks, Vec3, WORKBUFFER_UPDATE_ONCE, type AppBase, type Texture } from "playcanvas";
import { Actor, type Gaussians } from "./gaussians";
import type { Avatar, Motion } from "./index";

/** Where the engine's kernel of WebGL2 differs from that of mien's own renderer: its fall-off, cut-off and dilation (in half pixels). */
const REACH = Math.log(255);
const KERNEL: [string, RegExp, string][] = [
  ["gsplatPS", /= normExp\(A\)/, `= exp(A * -${REACH})`],
  ["gsplatCornerVS", /(diagonal\d = cov\[\d\]\[\d\]) \+ 0\.3/g, "$1 + 1.2"],
  ["gsplatCornerVS", /sqrt\(2\.0 \* lambda/g, `sqrt(${REACH / 2} * lambda`],
  ["gsplatCommonVS", /log\(alpha \/ alphaClipValue\)\)\) \* 0\.5/, `log(alpha / alphaClipValue))) * ${1 / Math.sqrt(REACH)}`],
];

const STREAMS = ["dataCenter", "dataColor", "dataScale", "dataRotation"];
const READ = {
  readGLSL: "vec3 getCenter() { return loadDataCenter().xyz; } vec4 getColor() { return loadDataColor(); } vec3 getScale() { return loadDataScale().xyz; } vec4 getRotation() { return loadDataRotation().wxyz; }",
  readWGSL: "fn getCenter() -> vec3f { return loadDataCenter().xyz; } fn getColor() -> vec4f { return loadDataColor(); } fn getScale() -> vec3f { return loadDataScale().xyz; } fn getRotation() -> vec4f { return loadDataRotation().wxyz; }",
};
/** How far a face may move beyond the box of the first one, in metres. The engine sorts in steps of a share of this box. */
const ROOM = 0.03;

/** An avatar of a stage. Its `node` has the head's axes: +x to the person's left, +y up, +z out of the face, in metres. */
export class SceneAvatar extends Actor {
  /** The entity: add it anywhere in the scene, move, turn, scale and disable it. */
  readonly node = new Entity("avatar");
  /** Where the camera was at the last pose, if colours depend on it. */
  seen = "";
  private readonly container: GSplatContainer;
  private readonly arrays: Required<Omit<Gaussians, "covariances">>;

  constructor(app: AppBase, avatar: Avatar, motion: Motion | null, private readonly gone: (avatar: SceneAvatar) => void) {
    super(avatar, motion, () => this.node.getWorldTransform().data);
    const { graphicsDevice: device } = app, n = this.source.count;
    this.container = new GSplatContainer(device, n, new GSplatFormat(device, STREAMS.map((name) => ({ name, format: PIXELFORMAT_RGBA32F })), READ));
    this.arrays = { centres: this.container.centers as Float32Array, colors: new Float32Array(4 * n), scales: new Float32Array(3 * n), rotations: new Float32Array(4 * n) };
    this.refresh();
    this.container.aabb = new BoundingBox();
    this.container.aabb.compute(this.arrays.centres as any);
    this.container.aabb.halfExtents.add(new Vec3(ROOM, ROOM, ROOM));
    this.node.addComponent("gsplat", { resource: this.container });
  }

  /** Poses the Gaussians in the frame of the node, and hands them to the engine. */
  refresh(eye?: ArrayLike<number>): void {
    const { arrays, container, source } = this;
    this.pose(arrays, { eye }, true);
    for (const [name, values] of [["dataCenter", arrays.centres], ["dataColor", arrays.colors], ["dataScale", arrays.scales], ["dataRotation", arrays.rotations]] as const) {
      const texture = container.getTexture(name) as Texture, texels = texture.lock() as Float32Array, width = values.length / source.count;
      if (width === 4) texels.set(values);
      else
        for (let i = 0, o = 0; i < values.length; i += 3, o += 4) {
          texels[o] = values[i];
          texels[o + 1] = values[i + 1];
          texels[o + 2] = values[i + 2];
        }
      texture.unlock();
    }
    container.update(source.count);
    // The engine copies splats once; without this, it would only sort them anew.
    if (this.node.gsplat) this.node.gsplat.workBufferUpdate = WORKBUFFER_UPDATE_ONCE;
  }

  dispose(): void {
    this.gone(this);
    this.node.destroy();
    this.container.destroy();
  }
}

/** The avatars of an app. It draws all splats of the app with the kernel of mien's renderer. */
export class Stage {
  readonly avatars: SceneAvatar[] = [];

  constructor(readonly app: AppBase) {
    const { gsplat } = app.scene, { material } = gsplat, shared = ShaderChunks.get(app.graphicsDevice, SHADERLANGUAGE_GLSL), own = material.getShaderChunks(SHADERLANGUAGE_GLSL);
    for (const [name, from, to] of KERNEL) own.set(name, (own.get(name) ?? shared.get(name)!).replace(from, to));
    material.update();
    gsplat.dataFormat = "large";
  }

  /** Puts an avatar into the scene. Its `dispose` takes it out. */
  add(avatar: Avatar, motion: Motion | null = null): SceneAvatar {
    const made = new SceneAvatar(this.app, avatar, motion, () => this.avatars.splice(this.avatars.indexOf(made), 1));
    this.avatars.push(made);
    this.app.root.addChild(made.node);
    return made;
  }

  /** Moves motions on by seconds, and takes over what has changed. Call it before each picture, as the app's event update does. */
  update(seconds: number, camera: Entity): void {
    const { x, y, z } = camera.getPosition(), eye = [x, y, z];
    for (const avatar of this.avatars) {
      avatar.update(seconds);
      const seen = avatar.source.viewDependent ? `${eye}` : "";
      if (avatar.changed || seen !== avatar.seen) avatar.refresh(eye);
      avatar.seen = seen;
    }
  }

  /** Takes all avatars out of the scene. */
  dispose(): void {
    for (const avatar of [...this.avatars]) avatar.dispose();
  }
}
