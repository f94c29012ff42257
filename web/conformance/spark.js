// A scene of three.js with Spark for the conformance page.
import * as THREE from "three";
import { Stage } from "mien-web/spark";

/** Opens an empty scene on a canvas, with a background of red, green and blue as the screen shows them. */
export async function open(canvas, background) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
  renderer.setSize(canvas.width, canvas.height, false);
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(25, canvas.width / canvas.height, 0.05, 20), stage = new Stage(scene, renderer);
  const shown = (color) => new THREE.Color().setRGB(...color, THREE.SRGBColorSpace);
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
    /** Draws until Spark's worker has sorted this picture, and returns it as a data address. */
    async draw() {
      camera.updateMatrixWorld();
      scene.updateMatrixWorld();
      stage.update(0, camera);
      const { spark } = stage;
      spark.autoUpdate = false;
      await spark.update({ scene, camera });
      while (spark.sorting || spark.sortDirty || spark.display !== spark.current) await new Promise((done) => setTimeout(done, 10));
      renderer.render(scene, camera);
      return canvas.toDataURL();
    },
    close() {
      stage.dispose();
      renderer.dispose();
    },
  };
}
