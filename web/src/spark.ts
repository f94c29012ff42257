// Avatars in a scene of three.js with Spark 2, whose splats they are: sorted with all others of the scene.

import { DataTexture, FloatType, RGBAFormat, type Object3D } from "three";
import { dyno, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { Actor } from "./gaussians";
import type { Avatar, Motion } from "./index";

/** Options of SparkRenderer that make its kernel that of mien's own renderer: its cut-off, its dilation, its order. */
export const KERNEL = { accumExtSplats: true, preBlurAmount: 0.3, blurAmount: 0, sortRadial: false, maxStdDev: Math.sqrt(2 * Math.log(255)), minAlpha: 1 / 255 };

/** Width of the textures that hold Gaussians. */
const WIDTH = 1024;

const spread = (from: Float32Array, to: Float32Array): void => {
  for (let i = 0, o = 0; i < from.length; i += 3, o += 4) {
    to[o] = from[i];
    to[o + 1] = from[i + 1];
    to[o + 2] = from[i + 2];
  }
};

/** Gaussians in textures of floats, from which Spark reads them. */
class Source {
  readonly colors: Float32Array;
  readonly rotations: Float32Array;
  readonly centres: Float32Array;
  readonly scales: Float32Array;
  private readonly textures: DataTexture[];
  private readonly uniforms: any[];

  constructor(private readonly count: number) {
    this.textures = Array.from({ length: 4 }, () => {
      const rows = Math.max(Math.ceil(count / WIDTH), 1), made = new DataTexture(new Float32Array(4 * WIDTH * rows), WIDTH, rows, RGBAFormat, FloatType);
      made.needsUpdate = true;
      return made;
    });
    this.uniforms = this.textures.map((value, k) => new dyno.DynoSampler2D({ key: `mien${k}`, value }));
    [this.rotations, this.colors] = [this.textures[2].image.data, this.textures[3].image.data].map((data) => data.subarray(0, 4 * count));
    [this.centres, this.scales] = [new Float32Array(3 * count), new Float32Array(3 * count)];
  }

  refresh(): void {
    spread(this.centres, this.textures[0].image.data);
    spread(this.scales, this.textures[1].image.data);
    for (const texture of this.textures) texture.needsUpdate = true;
  }

  // What Spark asks a source for.
  prepareFetchSplat(): void {}
  getNumSplats(): number {
    return this.count;
  }
  hasRgbDir(): boolean {
    return false;
  }
  getNumSh(): number {
    return 0;
  }
  setMaxSh(): void {}
  forEachSplat(): void {}
  dispose(): void {
    for (const texture of this.textures) texture.dispose();
  }

  fetchSplat({ index }: { index: any }): any {
    const names = ["a", "b", "c", "d"], inTypes = { index: "int", ...Object.fromEntries(names.map((name) => [name, "sampler2D"])) } as any;
    const read = new dyno.Dyno({
      inTypes, outTypes: { gsplat: dyno.Gsplat }, inputs: { index, ...Object.fromEntries(names.map((name, k) => [name, this.uniforms[k]])) } as any,
      globals: () => [dyno.defineGsplat],
      statements: ({ inputs, outputs: { gsplat } }: any) => [
        `ivec2 mienAt = ivec2(${inputs.index} % ${WIDTH}, ${inputs.index} / ${WIDTH});`,
        `${gsplat}.center = texelFetch(${inputs.a}, mienAt, 0).xyz;`,
        `${gsplat}.scales = texelFetch(${inputs.b}, mienAt, 0).xyz;`,
        `${gsplat}.quaternion = texelFetch(${inputs.c}, mienAt, 0);`,
        `${gsplat}.rgba = texelFetch(${inputs.d}, mienAt, 0);`,
        `${gsplat}.index = ${inputs.index};`,
        `${gsplat}.flags = ${inputs.index} < ${this.count} ? GSPLAT_FLAG_ACTIVE : 0u;`,
      ],
    } as any);
    return new dyno.DynoOutput(read as any, "gsplat");
  }
}

/** An avatar of a stage. Its `node` has the head's axes: +x to the person's left, +y up, +z out of the face, in metres. */
export class SceneAvatar extends Actor {
  /** The SplatMesh: add it anywhere in the scene, move, turn, scale and hide it. */
  readonly node: SplatMesh & Object3D;
  readonly splats: Source;
  /** Where the camera was at the last pose, if colours depend on it. */
  seen = "";

  constructor(avatar: Avatar, motion: Motion | null, private readonly gone: (avatar: SceneAvatar) => void) {
    super(avatar, motion, () => this.node.matrixWorld.elements);
    this.splats = new Source(this.source.count);
    this.node = new SplatMesh({ splats: this.splats as any, raycastable: false }) as SplatMesh & Object3D;
    this.node.numSplats = this.source.count;
  }

  /** Poses the Gaussians in the frame of the node, and says so to Spark. */
  refresh(eye: ArrayLike<number>): void {
    this.pose(this.splats, { eye }, true);
    this.splats.refresh();
    this.node.updateVersion();
  }

  dispose(): void {
    this.gone(this);
    this.node.removeFromParent();
    this.node.dispose();
    this.splats.dispose();
  }
}

/** The avatars of a scene. */
export class Stage {
  readonly avatars: SceneAvatar[] = [];
  /** What draws all splats of the scene. */
  readonly spark: SparkRenderer & Object3D;

  /** Without a SparkRenderer of the scene's own, one is made. `KERNEL` has the options that an own one should have. */
  constructor(readonly scene: Object3D, renderer: any, spark?: SparkRenderer) {
    this.spark = (spark ?? new SparkRenderer({ renderer, ...KERNEL })) as SparkRenderer & Object3D;
    if (!spark) scene.add(this.spark);
  }

  /** Puts an avatar into the scene. Its `dispose` takes it out. */
  add(avatar: Avatar, motion: Motion | null = null): SceneAvatar {
    const made = new SceneAvatar(avatar, motion, () => this.avatars.splice(this.avatars.indexOf(made), 1));
    this.avatars.push(made);
    this.scene.add(made.node);
    return made;
  }

  /** Moves motions on by seconds, and takes over what has changed. Call it before each picture. */
  update(seconds: number, camera: Object3D): void {
    const eye = camera.matrixWorld.elements.slice(12, 15);
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
