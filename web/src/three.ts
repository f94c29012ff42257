// Avatars in a scene of three.js (r187) with its WebGPURenderer, as the engine's own splats.

import { Object3D, Sphere } from "three/webgpu";
import * as tsl from "three/tsl";
import { GaussianSplat } from "three/addons/objects/GaussianSplat.js";
import { createGaussianSplatGeometry } from "three/addons/utils/GaussianSplatUtils.js";
import { Actor } from "./gaussians";
import type { Avatar, Motion } from "./index";

/** Alpha below which nothing is drawn, the largest alpha, and what a pixel adds to a variance: those of mien's own renderer. */
const LEAST_ALPHA = 1 / 255, MOST_ALPHA = 0.999, DILATION = 0.3;

/** The engine's splats with the kernel of mien's renderer. Its own cuts at two deviations and weakens small splats. */
class Splats extends GaussianSplat {
  /** 1 where the renderer turns linear light into sRGB, so that colours have to be linear before. */
  private readonly linear = tsl.uniform(0);
  private seen = "";

  constructor(readonly centres: Float32Array, readonly covariances: Float32Array, readonly bytes: Uint8ClampedArray) {
    super(createGaussianSplatGeometry(centres, covariances, bytes), { autoSort: false });
    this.frustumCulled = false;
    this.boundingSphere = new Sphere();
    const corner = tsl.varyingProperty("vec2", "vMienCorner"), color = tsl.varyingProperty("vec4", "vMienColor");
    this.material.vertexNode = this.vertex(corner, color);
    this.material.colorNode = tsl.Fn(() => {
      const alpha = tsl.min(tsl.exp(tsl.dot(corner, corner).mul(-0.5)).mul(color.a), MOST_ALPHA).toVar();
      tsl.If(alpha.lessThan(LEAST_ALPHA), () => void tsl.Discard());
      return tsl.vec4(color.rgb, alpha);
    })();
    this.onBeforeRender = (renderer: any, _: unknown, camera: any) => {
      this.linear.value = renderer.outputColorSpace === "srgb" ? 1 : 0;
      const view = camera.matrixWorldInverse.elements.join();
      if (view !== this.seen) this._sortInitialized = false;
      this.seen = view;
      this.updateSort(renderer, camera);
    };
  }

  /** Takes over what has been written into the arrays, which are those of the scene. */
  refresh(): void {
    const { centres, covariances, bytes, _buffers: buffers } = this, count = bytes.length / 4;
    const [to, a, b, words] = [buffers.centerRead, buffers.covarianceARead, buffers.covarianceBRead, buffers.colorRead].map((node) => node.value);
    const least = [Infinity, Infinity, Infinity], most = [-Infinity, -Infinity, -Infinity];
    for (let i = 0, p = 0, c = 0, o = 0; i < count; ++i, p += 3, c += 6, o += 4) {
      for (let axis = 0; axis < 3; ++axis) {
        const x = (to.array[o + axis] = centres[p + axis]);
        if (x < least[axis]) least[axis] = x;
        if (x > most[axis]) most[axis] = x;
      }
      for (let k = 0; k < 4; ++k) a.array[o + k] = covariances[c + k];
      b.array[o] = covariances[c + 4];
      b.array[o + 1] = covariances[c + 5];
    }
    words.array.set(new Uint32Array(bytes.buffer));
    for (const attribute of [to, a, b, words]) {
      attribute.needsUpdate = true;
      if (attribute.pbo) attribute.pbo.needsUpdate = true;
    }
    this.boundingSphere.center.set(...[0, 1, 2].map((axis) => (least[axis] + most[axis]) / 2));
    this.boundingSphere.radius = Math.hypot(...[0, 1, 2].map((axis) => most[axis] - least[axis])) / 2;
    this.boundingBox = null;
    this._sortInitialized = false;
  }

  private vertex(corner: any, color: any): any {
    const { _buffers: buffers, _sort: sort, linear } = this, { vec2, vec3, vec4, float, dot, sqrt } = tsl;
    return tsl.Fn(() => {
      const i = sort.orderRead.element(tsl.instanceIndex).toVar(), m = tsl.highpModelViewMatrix;
      const mean = m.mul(vec4(buffers.centerRead.element(i).xyz, 1)).toVar(), a = buffers.covarianceARead.element(i).toVar(), b = buffers.covarianceBRead.element(i).toVar();
      const seen = tsl.unpackUnorm4x8(buffers.colorRead.element(i)).toVar();
      const light = tsl.mix(seen.rgb.div(12.92), tsl.pow(seen.rgb.add(0.055).div(1.055), vec3(2.4)), tsl.step(0.04045, seen.rgb));
      color.assign(vec4(tsl.mix(seen.rgb, light, linear), seen.a));
      const focal = tsl.cameraViewport.zw.mul(0.5).mul(vec2(tsl.cameraProjectionMatrix[0].x, tsl.cameraProjectionMatrix[1].y)).toVar();
      const depth = tsl.max(mean.z.negate(), 0.01).toVar(), tangent = mean.xy.div(depth).toVar();
      // Rows of the projection's derivative in the scene.
      const row = (k: string) => vec3(m[0][k], m[1][k], m[2][k]);
      const n0 = row("x").add(row("z").mul(tangent.x)).mul(focal.x.div(depth)).toVar(), n1 = row("y").add(row("z").mul(tangent.y)).mul(focal.y.div(depth)).toVar();
      const times = (n: any) => vec3(dot(n, a.xyz), dot(n, vec3(a.y, a.w, b.x)), dot(n, vec3(a.z, b.x, b.y)));
      const c0 = times(n0).toVar(), xx = dot(c0, n0).add(DILATION).toVar(), xy = dot(c0, n1).toVar(), yy = dot(times(n1), n1).add(DILATION).toVar();
      const determinant = xx.mul(yy).sub(xy.mul(xy)).max(1e-12).toVar();
      const reach = sqrt(tsl.log(seen.a.div(LEAST_ALPHA)).mul(2).max(0)).add(0.1).toVar();
      corner.assign(tsl.positionGeometry.xy.mul(0.5).mul(reach));
      const up = sqrt(yy).mul(corner.y).toVar(), pixel = vec2(xy.div(yy).mul(up).add(sqrt(determinant.div(yy)).mul(corner.x)), up);
      const clip = tsl.cameraProjectionMatrix.mul(mean).toVar();
      clip.assign(clip.add(vec4(pixel.mul(2).div(tsl.cameraViewport.zw).mul(clip.w), 0, 0)));
      tsl.If(mean.z.greaterThan(-0.01).or(seen.a.lessThan(LEAST_ALPHA)), () => void clip.assign(vec4(float(2), 2, 2, 1)));
      return clip;
    })();
  }
}

/** An avatar of a stage. Its `node` has the head's axes: +x to the person's left, +y up, +z out of the face, in metres. */
export class SceneAvatar extends Actor {
  /** The object of the scene graph: add it anywhere, move, turn, scale and hide it. */
  readonly node = new Object3D();
  /** What was seen at the last pose. */
  seen = "";

  constructor(avatar: Avatar, motion: Motion | null, readonly dispose: () => void) {
    super(avatar, motion, () => this.node.matrixWorld.elements);
  }

  /** Whether it and all that it hangs on are visible, in the scene. */
  isVisible(scene: Object3D): boolean {
    let at = this.node;
    while (at.visible && at.parent) at = at.parent;
    return at.visible && at === scene;
  }
}

/** All avatars of a scene, which are one splat object, so that they are sorted together. */
export class Stage {
  readonly avatars: SceneAvatar[] = [];
  private splats: Splats | null = null;
  private colors = new Float32Array();

  constructor(readonly scene: Object3D) {}

  /** Puts an avatar into the scene. Its `dispose` takes it out. */
  add(avatar: Avatar, motion: Motion | null = null): SceneAvatar {
    const made = new SceneAvatar(avatar, motion, () => {
      this.avatars.splice(this.avatars.indexOf(made), 1);
      made.node.removeFromParent();
      this.clear();
    });
    this.avatars.push(made);
    this.scene.add(made.node);
    this.clear();
    return made;
  }

  /** Moves motions on by seconds, and takes over what has changed. Call it before each picture. */
  update(seconds: number, camera: Object3D): void {
    if (!this.avatars.length) return;
    this.scene.updateMatrixWorld();
    this.splats ??= this.made();
    const { centres, covariances, bytes } = this.splats, eye = camera.matrixWorld.elements.slice(12, 15);
    let first = 0, changed = false;
    for (const avatar of this.avatars) {
      const visible = avatar.isVisible(this.scene), from = 4 * first, to = from + 4 * avatar.source.count;
      avatar.update(seconds);
      const seen = `${visible} ${avatar.node.matrixWorld.elements} ${avatar.source.viewDependent ? eye : ""}`;
      if (avatar.changed || seen !== avatar.seen) {
        avatar.pose({ centres, covariances, colors: this.colors }, { first, eye });
        for (let k = from; k < to; ++k) bytes[k] = 255 * this.colors[k];
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
    const made = new Splats(new Float32Array(3 * count), new Float32Array(6 * count), new Uint8ClampedArray(4 * count));
    this.scene.add(made);
    return made;
  }

  private clear(): void {
    this.splats?.removeFromParent();
    this.splats?.material.dispose();
    this.splats?.geometry.dispose();
    this.splats = null;
    for (const avatar of this.avatars) avatar.change();
  }
}
