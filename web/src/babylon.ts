// Avatars in a scene of Babylon.js 9, as its own splats.

import { ShaderStore } from "@babylonjs/core/Engines/shaderStore.js";
import { GaussianSplattingMaterial } from "@babylonjs/core/Materials/GaussianSplatting/gaussianSplattingMaterial.js";
import { GaussianSplattingMesh } from "@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js";
import { TransformNode } from "@babylonjs/core/Meshes/transformNode.js";
import { ToHalfFloat } from "@babylonjs/core/Misc/textureTools.js";
import "@babylonjs/core/Shaders/gaussianSplatting.fragment.js";
import "@babylonjs/core/Shaders/gaussianSplatting.vertex.js";
import type { Camera } from "@babylonjs/core/Cameras/camera.js";
import type { Scene } from "@babylonjs/core/scene.js";
import { Actor, product } from "./gaussians";
import type { Avatar, Motion } from "./index";

/** Where the engine's kernel of WebGL2 differs from that of mien's own renderer: its cut-off, and its dilation (in half pixels). */
function setKernel(): void {
  const { ShadersStore: whole, IncludesShadersStore: parts } = ShaderStore, fragment = "gaussianSplattingFragmentDeclaration", vertex = "gaussianSplattingVertexShader";
  parts[fragment] = parts[fragment].replace("if (A<-4.0) discard;float B=exp(A)*inColor.a;", "float B=exp(A)*inColor.a;if (B<1./255.) discard;");
  whole[vertex] = whole[vertex].replace(/\bposition\.xy\b/g, `(position.xy*${Math.sqrt(Math.log(255)) / 2})`);
  GaussianSplattingMaterial.KernelSize = 1.2;
}

/** From the head's axes to those of a scene whose system is left-handed. */
const MIRROR = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1];
const Half = (globalThis as any).Float16Array;

/** The engine's splats, whose textures are written directly: its own way in has rotations of 8 bits. */
class Splats extends GaussianSplattingMesh {
  readonly centres: Float32Array;
  readonly covariances: Float32Array;
  readonly bytes: Uint8Array;
  private readonly a: Uint16Array;
  private readonly b: Uint16Array;

  constructor(scene: Scene, readonly count: number) {
    super("avatars", null, scene, false);
    this.alwaysSelectAsActiveMesh = true;
    this.isPickable = false;
    this.updateData(new ArrayBuffer(32 * count));
    const texels = this.inner._splatPositions.length / 4;
    [this.centres, this.covariances] = [new Float32Array(3 * count), new Float32Array(6 * count)];
    [this.a, this.b, this.bytes] = [new Uint16Array(4 * texels), new Uint16Array((this.inner._useRGBACovariants ? 4 : 2) * texels), new Uint8Array(4 * texels)];
  }

  /** What the engine keeps to itself. */
  private get inner(): any {
    return this;
  }

  /** Takes over what has been written into the arrays, which are those of the scene. */
  refresh(): void {
    const { centres, covariances, count, inner, a, b, bytes } = this, to = inner._splatPositions as Float32Array, width = inner._useRGBACovariants ? 4 : 2;
    const halves = Half ? [new Half(a.buffer), new Half(b.buffer)] : [a, b], half = Half ? (x: number) => x : ToHalfFloat;
    for (let i = 0, p = 0, c = 0, o = 0, d = 0; i < count; ++i, p += 3, c += 6, o += 4, d += width) {
      const most = Math.max(covariances[c], covariances[c + 3], covariances[c + 5], 1e-30);
      for (let axis = 0; axis < 3; ++axis) to[o + axis] = centres[p + axis];
      to[o + 3] = 4 * most;
      for (let k = 0; k < 4; ++k) halves[0][o + k] = half(covariances[c + k] / most);
      halves[1][d] = half(covariances[c + 4] / most);
      halves[1][d + 1] = half(covariances[c + 5] / most);
    }
    inner._updateTextures(a, b, bytes, undefined);
  }
}

/** An avatar of a stage. Its `node` has the head's axes: +x to the person's left, +y up, +z out of the face (-z in a left-handed scene), in metres. */
export class SceneAvatar extends Actor {
  /** The node: parent, move, turn, scale and disable it. */
  readonly node: TransformNode;
  /** What was seen at the last pose. */
  seen = "";

  constructor(scene: Scene, avatar: Avatar, motion: Motion | null, readonly dispose: () => void) {
    super(avatar, motion, () => {
      const { m } = this.node.computeWorldMatrix(true);
      return scene.useRightHandedSystem ? m : product(m, MIRROR);
    });
    this.node = new TransformNode("avatar", scene);
  }
}

/** All avatars of a scene, which are one mesh of splats, so that they are sorted together. */
export class Stage {
  readonly avatars: SceneAvatar[] = [];
  private splats: Splats | null = null;
  private colors = new Float32Array();

  constructor(readonly scene: Scene) {
    setKernel();
  }

  /** Puts an avatar into the scene. Its `dispose` takes it out. */
  add(avatar: Avatar, motion: Motion | null = null): SceneAvatar {
    const made = new SceneAvatar(this.scene, avatar, motion, () => {
      this.avatars.splice(this.avatars.indexOf(made), 1);
      made.node.dispose();
      this.clear();
    });
    this.avatars.push(made);
    this.clear();
    return made;
  }

  /** Moves motions on by seconds, and takes over what has changed. Call it before each picture. */
  update(seconds: number, camera: Camera): void {
    if (!this.avatars.length) return;
    this.splats ??= this.made();
    const { centres, covariances, bytes } = this.splats, { x, y, z } = camera.globalPosition, eye = [x, y, z];
    let first = 0, changed = false;
    for (const avatar of this.avatars) {
      const visible = avatar.node.isEnabled(), from = 4 * first, to = from + 4 * avatar.source.count;
      avatar.update(seconds);
      const seen = `${visible} ${avatar.node.computeWorldMatrix(true).m} ${avatar.source.viewDependent ? eye : ""}`;
      if (avatar.changed || seen !== avatar.seen) {
        avatar.pose({ centres, covariances, colors: this.colors }, { first, eye });
        for (let k = from; k < to; ++k) bytes[k] = Math.min(255 * this.colors[k] + 0.5, 255);
        if (!visible) for (let k = from + 3; k < to; k += 4) bytes[k] = 0;
        changed = true;
      }
      avatar.seen = seen;
      first = to / 4;
    }
    if (changed) this.splats.refresh();
  }

  /** Takes all avatars out of the scene. */
  dispose(): void {
    for (const avatar of [...this.avatars]) avatar.dispose();
  }

  private made(): Splats {
    const count = this.avatars.reduce((sum, { source }) => sum + source.count, 0);
    this.colors = new Float32Array(4 * count);
    return new Splats(this.scene, count);
  }

  private clear(): void {
    this.splats?.dispose();
    this.splats = null;
    for (const avatar of this.avatars) avatar.change();
  }
}
