// Two avatars in a room of PlayCanvas, with a cube that passes before and behind them. Put me.packed beside index.html.
import * as pc from "playcanvas";
import { CameraControls } from "playcanvas/scripts/esm/camera-controls.mjs";
import { readAny } from "mien-web";
import { enliven } from "mien-web/motion";
import { Stage } from "mien-web/playcanvas";

export async function start(canvas, file) {
  const { avatar, motion } = await readAny(file);
  const app = new pc.Application(canvas, { mouse: new pc.Mouse(canvas), keyboard: new pc.Keyboard(window), touch: new pc.TouchDevice(canvas), graphicsDeviceOptions: { antialias: false } });
  app.setCanvasFillMode(pc.FILLMODE_FILL_WINDOW);
  app.setCanvasResolution(pc.RESOLUTION_AUTO);
  app.scene.ambientLight = new pc.Color(0.6, 0.6, 0.6);
  const stage = new Stage(app), camera = new pc.Entity("camera"), lamp = new pc.Entity("lamp");
  const box = (color, place, size) => {
    const material = new pc.StandardMaterial(), made = new pc.Entity("box");
    material.diffuse = new pc.Color().fromString(color);
    material.update();
    made.addComponent("render", { type: "box", material });
    made.setLocalScale(...size);
    made.setPosition(...place);
    app.root.addChild(made);
    return made;
  };
  lamp.addComponent("light", { type: "directional", intensity: 0.7 });
  lamp.setEulerAngles(40, 30, 0);
  app.root.addChild(lamp);
  box("#d8cfc4", [0, -0.2, 0], [2.4, 0.02, 2.4]);
  box("#c3d0d6", [0, 0.6, -0.8], [2.4, 1.6, 0.02]);
  const cube = box("#d05030", [0, 0, 0], [0.07, 0.07, 0.07]);
  const left = stage.add(avatar, motion), right = stage.add(avatar);
  left.node.setPosition(-0.13, 0, 0);
  right.node.setPosition(0.13, 0, 0);
  right.node.setEulerAngles(0, -17, 0);
  if (motion) left.play();
  right.alive = (face) => enliven(face, avatar, { idle: true, pointer: null }, performance.now() / 1000);
  camera.addComponent("camera", { fov: 30, nearClip: 0.05, farClip: 20 });
  camera.setPosition(0, 0.1, 1.1);
  app.root.addChild(camera);
  camera.addComponent("script");
  camera.script.create(CameraControls, { properties: { focusPoint: new pc.Vec3() } });
  let angle = 0;
  app.on("update", (seconds) => {
    angle += seconds;
    cube.setPosition(0.13 + 0.2 * Math.sin(angle), 0.02, 0.2 * Math.cos(angle));
    const { x, y, z } = cube.getPosition();
    right.lookAt([x, y, z]);
    stage.update(seconds, camera);
  });
  app.start();
  return { left, right, cube, camera, stage };
}
