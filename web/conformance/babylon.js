// A scene of Babylon.js for the conformance page.
import { FreeCamera } from "@babylonjs/core/Cameras/freeCamera.js";
import { Engine } from "@babylonjs/core/Engines/engine.js";
import { StandardMaterial } from "@babylonjs/core/Materials/standardMaterial.js";
import { Color3, Color4 } from "@babylonjs/core/Maths/math.color.js";
import { Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import { CreateBox } from "@babylonjs/core/Meshes/Builders/boxBuilder.js";
import { TransformNode } from "@babylonjs/core/Meshes/transformNode.js";
import { Scene } from "@babylonjs/core/scene.js";
import { Stage } from "mien-web/babylon";

/** Opens an empty scene on a canvas, with a background of red, green and blue as the screen shows them. */
export async function open(canvas, background) {
  const { width, height } = canvas, engine = new Engine(canvas, false, { preserveDrawingBuffer: true }), scene = new Scene(engine);
  engine.setSize(width, height);
  scene.useRightHandedSystem = true;
  scene.clearColor = new Color4(...background, 1);
  const camera = new FreeCamera("camera", Vector3.Zero(), scene), stage = new Stage(scene);
  [camera.minZ, camera.maxZ] = [0.05, 20];
  return {
    add(avatar, place) {
      const made = stage.add(avatar);
      made.node.position.set(...place);
      return made;
    },
    hide(made, hidden) {
      made.node.setEnabled(!hidden);
    },
    hang(made, place) {
      const parent = new TransformNode("parent", scene);
      parent.position.set(...place);
      made.node.parent = parent;
    },
    box(place, size, color) {
      const made = CreateBox("box", { size }, scene), material = (made.material = new StandardMaterial("box", scene));
      material.disableLighting = true;
      material.emissiveColor = new Color3(...color);
      made.position.set(...place);
      return { remove: () => made.dispose() };
    },
    look(eye, target, fov) {
      camera.fov = (fov * Math.PI) / 180;
      camera.position.set(...eye);
      camera.setTarget(new Vector3(...target));
    },
    /** Draws until the engine has its shaders and its worker has sorted this picture, and returns it as a data address. */
    async draw() {
      camera.computeWorldMatrix(true);
      stage.update(0, camera);
      let shown = "";
      for (let same = 0, last = ""; same < 3 || !scene.isReady(); last = shown) {
        scene.render();
        shown = canvas.toDataURL();
        await new Promise((done) => setTimeout(done, 100));
        same = shown === last ? same + 1 : 0;
      }
      return shown;
    },
    close() {
      stage.dispose();
      engine.dispose();
    },
  };
}
