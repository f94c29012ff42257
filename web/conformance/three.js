// A scene of three.js for the conformance page.
import * as THREE from "three/webgpu";
import { Stage } from "mien-web/three";

/** Opens an empty scene on a canvas, with a background of red, green and blue as the screen shows them. */
export async function open(canvas, background) {
  const renderer = new THREE.WebGPURenderer({ canvas, antialias: false, forceWebGL: !(await navigator.gpu?.requestAdapter()) });
  // Gaussians were trained to blend as the screen shows colours, so nothing is turned into linear light.
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  renderer.setSize(canvas.width, canvas.height, false);
  await renderer.init();
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(25, canvas.width / canvas.height, 0.05, 20), stage = new Stage(scene);
  const shown = (color) => new THREE.Color().setRGB(...color, THREE.LinearSRGBColorSpace);
  scene.background = shown(background);
  return {
    add(avatar, [x, y, z]) {
      const made = stage.add(avatar);
      made.node.position.set(x, y, z);
      return made;
    },
    hide(made, hidden) {
      made.node.visible = !hidden;
    },
    hang(made, place) {
      const parent = new THREE.Group();
      parent.position.set(...place);
      scene.add(parent);
      parent.add(made.node);
    },
    box([x, y, z], size, color) {
      const made = new THREE.Mesh(new THREE.BoxGeometry(size, size, size), new THREE.MeshBasicMaterial({ color: shown(color) }));
      made.position.set(x, y, z);
      scene.add(made);
      return { remove: () => made.removeFromParent() };
    },
    look(eye, target, fov) {
      camera.fov = fov;
      camera.updateProjectionMatrix();
      camera.position.set(...eye);
      camera.lookAt(...target);
    },
    /** Draws, and returns the picture as a data address. */
    async draw() {
      stage.update(0, camera);
      renderer.render(scene, camera);
      return canvas.toDataURL();
    },
    close() {
      stage.dispose();
      renderer.dispose();
    },
  };
}
