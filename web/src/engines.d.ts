// What the adapters use of three.js, which has no types of its own. With @types/three, a project sees the real ones.
declare module "three" {
  export class DataTexture {
    [name: string]: any;
    constructor(...given: any[]);
  }
  export const FloatType: any, RGBAFormat: any;
  export class Object3D {
    [name: string]: any;
  }
}
declare module "three/webgpu" {
  export * from "three";
  export class Sphere {
    [name: string]: any;
  }
}
declare module "three/tsl" {
  export const cameraProjectionMatrix: any, cameraViewport: any, dot: any, Discard: any, exp: any, float: any, Fn: any, highpModelViewMatrix: any, If: any, instanceIndex: any;
  export const log: any, max: any, min: any, mix: any, positionGeometry: any, pow: any, sqrt: any, step: any, uniform: any, unpackUnorm4x8: any, varyingProperty: any, vec2: any, vec3: any, vec4: any;
}
declare module "three/addons/objects/GaussianSplat.js" {
  export class GaussianSplat {
    [name: string]: any;
    constructor(geometry: any, options?: { autoSort?: boolean });
  }
}
declare module "three/addons/utils/GaussianSplatUtils.js" {
  export function createGaussianSplatGeometry(centres: Float32Array, covariances: Float32Array, colors: Uint8ClampedArray): any;
}

declare module "*.wasm" {
  const bytes: Uint8Array<ArrayBuffer>;
  export default bytes;
}
