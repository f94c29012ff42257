// An avatar between ordinary objects of a three.js scene. Bundle it with any bundler: npm install three mien-web
import * as THREE from "three";
import { readAny, Viewer } from "mien-web";

/** An object whose axes are those of the head: +x to the person's left, +y up, +z out of the face, in metres. */
export class AvatarObject extends THREE.Mesh {
  constructor(avatar, motion = null) {
    const canvas = document.createElement("canvas");
    const picture = new THREE.CanvasTexture(canvas);
    picture.premultiplyAlpha = true;
    const geometry = new THREE.PlaneGeometry(2, 2);
    // The picture fills the screen, at the depth of the head's middle: what is nearer hides it, what is farther is hidden.
    const material = new THREE.ShaderMaterial({
      uniforms: { picture: { value: picture }, depth: { value: 0 } },
      vertexShader: "varying vec2 at; uniform float depth; void main() { at = uv; gl_Position = vec4(position.xy, depth, 1.); }",
      fragmentShader: "varying vec2 at; uniform sampler2D picture; void main() { gl_FragColor = texture2D(picture, at); if (gl_FragColor.a < .004) discard; }",
      transparent: true, premultipliedAlpha: true, depthWrite: false,
      blending: THREE.CustomBlending, blendSrc: THREE.OneFactor, blendDst: THREE.OneMinusSrcAlphaFactor,
    });
    super(geometry, material);
    this.frustumCulled = false;
    this.viewer = new Viewer(canvas, avatar, motion);
    this.picture = picture;
  }

  onBeforeRender(renderer, scene, camera) {
    const { viewer, material, picture } = this, size = renderer.getDrawingBufferSize(new THREE.Vector2());
    if (viewer.canvas.width !== size.x || viewer.canvas.height !== size.y) {
      [viewer.canvas.width, viewer.canvas.height] = [size.x, size.y];
      picture.dispose();
    }
    const headToCamera = new THREE.Matrix4().multiplyMatrices(camera.matrixWorldInverse, this.matrixWorld);
    viewer.matrices = { projection: camera.projectionMatrix.elements, headToCamera: headToCamera.elements };
    viewer.draw();
    picture.needsUpdate = true;
    const middle = new THREE.Vector3().setFromMatrixPosition(this.matrixWorld).project(camera);
    material.uniforms.depth.value = middle.z;
  }
}

export async function start(canvas, file) {
  const { avatar, motion } = await readAny(file);
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
  renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(25, canvas.clientWidth / canvas.clientHeight, 0.05, 10);
  scene.background = new THREE.Color(0xdde4ea);
  scene.add(new THREE.HemisphereLight(0xffffff, 0x667788, 3));
  const box = (color, x, y, z, size) => {
    const made = new THREE.Mesh(new THREE.BoxGeometry(size, size, size), new THREE.MeshStandardMaterial({ color }));
    made.position.set(x, y, z);
    scene.add(made);
    return made;
  };
  const head = new AvatarObject(avatar, motion);
  scene.add(head);
  const boxes = { front: box(0xd05030, 0.05, -0.08, 0.2, 0.05), behind: box(0x3060d0, -0.08, 0.08, -0.2, 0.16) };
  const look = (degrees) => {
    const turn = THREE.MathUtils.degToRad(degrees);
    camera.position.set(0.8 * Math.sin(turn), 0.05, 0.8 * Math.cos(turn));
    camera.lookAt(0, 0, 0);
    renderer.render(scene, camera);
  };
  look(0);
  return { head, boxes, camera, look, renderer };
}
