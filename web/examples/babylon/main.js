// Two avatars in a room of Babylon.js, with a cube that passes before and behind them. Put me.packed beside index.html.
import { ArcRotateCamera } from "@babylonjs/core/Cameras/arcRotateCamera.js";
import { Engine } from "@babylonjs/core/Engines/engine.js";
import { HemisphericLight } from "@babylonjs/core/Lights/hemisphericLight.js";
import { StandardMaterial } from "@babylonjs/core/Materials/standardMaterial.js";
import { Color3 } from "@babylonjs/core/Maths/math.color.js";
import { Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import { CreateBox } from "@babylonjs/core/Meshes/Builders/boxBuilder.js";
import { Scene } from "@babylonjs/core/scene.js";
import { readAny } from "mien-web";
import { enliven } from "mien-web/motion";
import { Stage } from "mien-web/babylon";

export async function start(canvas, file) {
  const { avatar, motion } = await readAny(file);
  const engine = new Engine(canvas, true), scene = new Scene(engine);
  scene.useRightHandedSystem = true;
  const camera = new ArcRotateCamera("camera", Math.PI / 2, 1.48, 1.1, Vector3.Zero(), scene), stage = new Stage(scene);
  const box = (color, place, [width, height, depth]) => {
    const made = CreateBox("box", { width, height, depth }, scene), material = (made.material = new StandardMaterial("box", scene));
    material.diffuseColor = Color3.FromHexString(color);
    material.specularColor = Color3.Black();
    made.position.set(...place);
    return made;
  };
  new HemisphericLight("light", new Vector3(0.2, 1, 0.4), scene).groundColor = new Color3(0.6, 0.55, 0.5);
  box("#d8cfc4", [0, -0.2, 0], [2.4, 0.02, 2.4]);
  box("#c3d0d6", [0, 0.6, -0.8], [2.4, 1.6, 0.02]);
  const cube = box("#d05030", [0, 0, 0], [0.07, 0.07, 0.07]);
  const left = stage.add(avatar, motion), right = stage.add(avatar);
  left.node.position.set(-0.13, 0, 0);
  right.node.position.set(0.13, 0, 0);
  right.node.rotation.y = -0.3;
  if (motion) left.play();
  right.alive = (face) => enliven(face, avatar, { idle: true, pointer: null }, performance.now() / 1000);
  Object.assign(camera, { fov: 0.52, minZ: 0.05, maxZ: 20, wheelPrecision: 300 });
  camera.attachControl(canvas, true);
  let angle = 0;
  engine.runRenderLoop(() => {
    const seconds = engine.getDeltaTime() / 1000;
    angle += seconds;
    engine.resize();
    cube.position.set(0.13 + 0.2 * Math.sin(angle), 0.02, 0.2 * Math.cos(angle));
    right.lookAt(cube.position.asArray());
    stage.update(seconds, camera);
    scene.render();
  });
  return { left, right, cube, camera, stage };
}
