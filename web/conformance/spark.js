// A scene of three.js with Spark for the conformance page.
import * as THREE from "three";
import { Stage } from "mien-web/spark";
import { sceneOf } from "./three_scene.js";

/** Opens an empty scene on a canvas, with a background of red, green and blue as the screen shows them. */
export async function open(canvas, background) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
  const { scene, camera, acts } = sceneOf(THREE, renderer, canvas, background, THREE.SRGBColorSpace), stage = new Stage(scene, renderer);
  return {
    ...acts(stage),
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
  };
}
