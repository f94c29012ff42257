// A scene of three.js for the conformance page.
import * as THREE from "three/webgpu";
import { Stage } from "mien-web/three";
import { sceneOf } from "./three_scene.js";

/** Opens an empty scene on a canvas, with a background of red, green and blue as the screen shows them. */
export async function open(canvas, background) {
  const renderer = new THREE.WebGPURenderer({ canvas, antialias: false, forceWebGL: !(await navigator.gpu?.requestAdapter()) });
  // Gaussians were trained to blend as the screen shows colours, so nothing is turned into linear light.
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  await renderer.init();
  const { scene, camera, acts } = sceneOf(THREE, renderer, canvas, background, THREE.LinearSRGBColorSpace), stage = new Stage(scene);
  return {
    ...acts(stage),
    /** Draws, and returns the picture as a data address. */
    async draw() {
      stage.update(0, camera);
      renderer.render(scene, camera);
      return canvas.toDataURL();
    },
  };
}
