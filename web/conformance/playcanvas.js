// A scene of PlayCanvas for the conformance page.
import * as pc from "playcanvas";
import { Stage } from "mien-web/playcanvas";

/** Opens an empty scene on a canvas, with a background of red, green and blue as the screen shows them. */
export async function open(canvas, background) {
  const { width, height } = canvas;
  const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false, alpha: false, preserveDrawingBuffer: true } });
  app.setCanvasFillMode(pc.FILLMODE_NONE, width, height);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, width, height);
  const camera = new pc.Entity("camera"), stage = new Stage(app);
  camera.addComponent("camera", { clearColor: new pc.Color(...background), fov: 25, nearClip: 0.05, farClip: 20 });
  app.root.addChild(camera);
  app.autoRender = false;
  app.start();
  const frame = () => new Promise((done) => {
    app.once("frameend", done);
    app.renderNextFrame = true;
  });
  return {
    add(avatar, place) {
      const made = stage.add(avatar);
      made.node.setPosition(...place);
      return made;
    },
    hide(made, hidden) {
      made.node.enabled = !hidden;
    },
    hang(made, place) {
      const parent = new pc.Entity("parent");
      parent.setPosition(...place);
      app.root.addChild(parent);
      made.node.reparent(parent);
    },
    box(place, size, color) {
      const material = new pc.StandardMaterial(), made = new pc.Entity("box");
      Object.assign(material, { useLighting: false, emissive: new pc.Color(...color) });
      material.update();
      made.addComponent("render", { type: "box", material });
      made.setLocalScale(size, size, size);
      made.setPosition(...place);
      app.root.addChild(made);
      return { remove: () => made.destroy() };
    },
    look(eye, target, fov) {
      camera.camera.fov = fov;
      camera.setPosition(...eye);
      camera.lookAt(...target);
    },
    /** Draws until the engine's worker has sorted this picture, and returns it as a data address. */
    async draw() {
      stage.update(0, camera);
      let shown = "", sorts = 0, same = 0;
      const sorted = app.scene.on("gsplat:sorted", () => ++sorts && (same = 0));
      // A sort may be on its way that began before: wait for one, or long enough that none can come.
      for (let last = ""; same < (sorts ? 4 : 12); last = shown) {
        await frame();
        await new Promise((done) => setTimeout(done, 50));
        shown = canvas.toDataURL();
        same = shown === last ? same + 1 : 0;
      }
      sorted.off();
      return shown;
    },
    close() {
      stage.dispose();
      app.destroy();
    },
  };
}
